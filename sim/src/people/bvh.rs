//! BVH files: a hierarchy of joints with offsets and channels, and one line of numbers for each frame.
//!
//! The file does not state its length unit. y points up. Angles are in degrees and are applied in the order of the
//! channels, from the parent outwards (`R = R_1 R_2 R_3` of the joint's own lines).

use glam::{DMat3, DVec3};

use crate::file_error::FileError;

/// Content of a BVH file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Bvh {
    /// Joints, parents first. An end site is a joint without channels and name.
    pub joints: Vec<BvhJoint>,
    /// Time from frame to frame, s.
    pub frame_time_s: f64,
    /// Numbers of each frame: the channels of the first joint, then those of the next, in the order of `joints`.
    pub frames: Vec<Vec<f64>>,
}

/// A joint of the hierarchy.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BvhJoint {
    /// Name of the joint; empty for an end site.
    pub name: String,
    /// Index of the parent joint; `None` for the root.
    pub parent: Option<usize>,
    /// Offset from the parent in the rest pose, in the file's unit.
    pub offset: DVec3,
    /// Channels that each frame contains for this joint.
    pub channels: Vec<Channel>,
}

/// Meaning of one number of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    /// Position along an axis (0, 1, 2), in the file's unit.
    Position(usize),
    /// Rotation about an axis (0, 1, 2), degrees.
    Rotation(usize),
}

/// Upper limits: number of joints, and number of frames times number of channels. Larger files are refused.
const MOST_JOINTS: usize = 4096;
const MOST_NUMBERS: usize = 100_000_000;
/// Upper limit of the text's length, bytes. Ten minutes of a hundred channels at 120 Hz take 60 MB, and a word takes 24
/// bytes of memory.
const LARGEST_BYTES: usize = 64 << 20;

const CHANNELS: [(&str, Channel); 6] = [
    ("Xposition", Channel::Position(0)),
    ("Yposition", Channel::Position(1)),
    ("Zposition", Channel::Position(2)),
    ("Xrotation", Channel::Rotation(0)),
    ("Yrotation", Channel::Rotation(1)),
    ("Zrotation", Channel::Rotation(2)),
];

/// Error at a line: the text that was found, and the text that was expected.
fn error_at_line(line: usize, found: &str, expected: &str) -> FileError {
    let problem = format!("{found}, expected {expected}");
    FileError::new(format!("line {line}"), problem, "export the clip again as BVH, one line a frame")
}

/// Words of the text with their line numbers.
struct Words<'a> {
    all: Vec<(usize, &'a str)>,
    /// Index of the next word.
    next_word: usize,
    line_count: usize,
}

impl<'a> Words<'a> {
    fn new(text: &'a str) -> Self {
        let line = |(i, line): (usize, &'a str)| line.split_whitespace().map(move |word| (i + 1, word));
        Words {
            all: text.lines().enumerate().flat_map(line).collect(),
            next_word: 0,
            line_count: text.lines().count().max(1),
        }
    }

    fn peek(&self) -> Option<&'a str> {
        self.all.get(self.next_word).map(|(_, word)| *word)
    }

    fn line(&self) -> usize {
        self.all.get(self.next_word).map_or(self.line_count, |(line, _)| *line)
    }

    fn error_here(&self, expected: &str) -> FileError {
        let found = self.peek().map_or("the file ends".to_owned(), |word| format!("found {word:?}"));
        error_at_line(self.line(), &found, expected)
    }

    fn expect(&mut self, word: &str) -> Result<(), FileError> {
        if self.peek().is_some_and(|w| w.eq_ignore_ascii_case(word)) {
            self.next_word += 1;
            return Ok(());
        }
        Err(self.error_here(&format!("{word:?}")))
    }

    /// Parses the next word and moves past it.
    fn next<T>(&mut self, expected: &str, parse: impl Fn(&'a str) -> Option<T>) -> Result<T, FileError> {
        let parsed = self.peek().and_then(parse).ok_or_else(|| self.error_here(expected))?;
        self.next_word += 1;
        Ok(parsed)
    }

    fn number(&mut self, expected: &str) -> Result<f64, FileError> {
        self.next(expected, |word| word.parse().ok().filter(|number: &f64| number.is_finite()))
    }

    fn count(&mut self, expected: &str) -> Result<usize, FileError> {
        self.next(expected, |word| word.parse().ok())
    }

    fn offset(&mut self) -> Result<DVec3, FileError> {
        self.expect("OFFSET")?;
        let mut number = || self.number("three finite numbers after OFFSET");
        Ok(DVec3::new(number()?, number()?, number()?))
    }
}

/// Parses a BVH file.
///
/// # Errors
/// [`FileError`] at the first line that is not as expected, for frames that are missing, and for a file beyond the
/// limits.
pub fn parse_bvh(text: &str) -> Result<Bvh, FileError> {
    if text.len() > LARGEST_BYTES {
        return Err(error_at_line(
            1,
            &format!("the text has {} bytes", text.len()),
            &format!("{LARGEST_BYTES} at most"),
        ));
    }
    let mut words = Words::new(text);
    let joints = hierarchy(&mut words)?;
    words.expect("MOTION")?;
    words.expect("Frames:")?;
    let count = words.count("the number of frames")?;
    words.expect("Frame")?;
    words.expect("Time:")?;
    let frame_time_s = words.number("the time of a frame, s")?;
    if !(1e-4..=1.0).contains(&frame_time_s) {
        words.next_word -= 1;
        return Err(words.error_here("0.0001 to 1 s from frame to frame"));
    }
    let width: usize = joints.iter().map(|j| j.channels.len()).sum();
    let frames = frames(&mut words, count, width)?;
    Ok(Bvh { joints, frame_time_s, frames })
}

/// Parses the joints, parents first.
fn hierarchy(words: &mut Words) -> Result<Vec<BvhJoint>, FileError> {
    words.expect("HIERARCHY")?;
    words.expect("ROOT")?;
    let mut joints: Vec<BvhJoint> = Vec::new();
    // Joints whose braces are not closed yet.
    let mut open_joints: Vec<usize> = Vec::new();
    let mut name = joint_name(words);
    loop {
        if joints.len() >= MOST_JOINTS {
            return Err(words.error_here(&format!("at most {MOST_JOINTS} joints")));
        }
        words.expect("{")?;
        let end_site = name.is_empty();
        let offset = words.offset()?;
        let channels = if end_site { Vec::new() } else { channels(words)? };
        joints.push(BvhJoint {
            name: std::mem::take(&mut name),
            parent: open_joints.last().copied(),
            offset,
            channels,
        });
        open_joints.push(joints.len() - 1);
        if end_site {
            words.expect("}")?;
            open_joints.pop();
        }
        while words.peek() == Some("}") && !open_joints.is_empty() {
            words.next_word += 1;
            open_joints.pop();
        }
        if open_joints.is_empty() {
            return Ok(joints);
        }
        match words.next("JOINT, End Site or }", Some)? {
            word if word.eq_ignore_ascii_case("JOINT") => name = joint_name(words),
            word if word.eq_ignore_ascii_case("End") => words.expect("Site")?,
            _ => {
                words.next_word -= 1;
                return Err(words.error_here("JOINT, End Site or }"));
            }
        }
        if name.is_empty() && words.peek() != Some("{") {
            return Err(words.error_here("{"));
        }
    }
}

/// Parses `count` frames of `width` numbers, one frame a line. The text must end after the last frame.
fn frames(words: &mut Words, count: usize, width: usize) -> Result<Vec<Vec<f64>>, FileError> {
    if count.saturating_mul(width) > MOST_NUMBERS {
        return Err(words.error_here(&format!("at most {MOST_NUMBERS} numbers in all")));
    }
    if width == 0 && count > 0 {
        let found = format!("{count} frames of a skeleton without channels");
        return Err(error_at_line(words.line(), &found, "a joint with channels"));
    }
    // No memory is reserved for frames that the text may not contain.
    let mut frames = Vec::new();
    for frame in 0..count {
        let first_line = words.line();
        let expected = format!("{width} finite numbers for frame {frame} of {count}");
        let row = (0..width).map(|_| words.number(&expected)).collect::<Result<Vec<f64>, FileError>>()?;
        // A line that is too short would take its numbers from the next line.
        let last_line = words.all.get(words.next_word - 1).map_or(first_line, |(line, _)| *line);
        if last_line != first_line {
            let found = format!("frame {frame} has too few numbers");
            return Err(error_at_line(first_line, &found, &format!("{width} on its line")));
        }
        frames.push(row);
    }
    if words.peek().is_some() {
        return Err(words.error_here(&format!("the end of the file after {count} frames of {width} numbers")));
    }
    Ok(frames)
}

/// Parses a joint's name, which may contain blanks.
fn joint_name(words: &mut Words) -> String {
    let line = words.line();
    let mut words_of_name = Vec::new();
    while let Some(word) = words.peek().filter(|w| *w != "{" && words.line() == line) {
        words_of_name.push(word);
        words.next_word += 1;
    }
    if words_of_name.is_empty() { "joint".to_owned() } else { words_of_name.join(" ") }
}

fn channels(words: &mut Words) -> Result<Vec<Channel>, FileError> {
    words.expect("CHANNELS")?;
    let count = words.count("the number of channels")?;
    if count > 6 {
        words.next_word -= 1;
        return Err(words.error_here("at most 6 channels"));
    }
    let channel = |word: &str| CHANNELS.iter().find(|(name, _)| name.eq_ignore_ascii_case(word)).map(|(_, c)| *c);
    (0..count).map(|_| words.next("Xposition, Yrotation or the like", channel)).collect()
}

impl Bvh {
    /// Returns the positions of the joints in a frame, in the file's unit and axes. Without a frame, returns the rest
    /// pose.
    pub fn joint_positions(&self, frame: Option<usize>) -> Vec<DVec3> {
        let mut channel_values = frame.and_then(|f| self.frames.get(f)).into_iter().flatten();
        let mut world: Vec<(DVec3, DMat3)> = Vec::with_capacity(self.joints.len());
        for joint in &self.joints {
            let (parent_position, parent_rotation) =
                joint.parent.and_then(|p| world.get(p).copied()).unwrap_or((DVec3::ZERO, DMat3::IDENTITY));
            let (mut offset, mut rotation) = (joint.offset, DMat3::IDENTITY);
            for channel in &joint.channels {
                let Some(&value) = channel_values.next() else { break };
                match *channel {
                    Channel::Position(axis) => offset[axis] = value,
                    Channel::Rotation(0) => rotation *= DMat3::from_rotation_x(value.to_radians()),
                    Channel::Rotation(1) => rotation *= DMat3::from_rotation_y(value.to_radians()),
                    Channel::Rotation(_) => rotation *= DMat3::from_rotation_z(value.to_radians()),
                }
            }
            world.push((parent_position + parent_rotation * offset, parent_rotation * rotation));
        }
        world.into_iter().map(|(position, _)| position).collect()
    }
}
