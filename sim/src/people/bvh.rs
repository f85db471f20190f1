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
fn error(line: usize, found: &str, expected: &str) -> FileError {
    let problem = format!("{found}, expected {expected}");
    FileError::new(format!("line {line}"), problem, "export the clip again as BVH, one line a frame")
}

/// Words of the text with their line numbers.
struct Words<'a> {
    all: Vec<(usize, &'a str)>,
    at: usize,
    last_line: usize,
}

impl<'a> Words<'a> {
    fn new(text: &'a str) -> Self {
        let line = |(i, line): (usize, &'a str)| line.split_whitespace().map(move |word| (i + 1, word));
        Words { all: text.lines().enumerate().flat_map(line).collect(), at: 0, last_line: text.lines().count().max(1) }
    }

    fn peek(&self) -> Option<&'a str> {
        self.all.get(self.at).map(|(_, word)| *word)
    }

    fn line(&self) -> usize {
        self.all.get(self.at).map_or(self.last_line, |(line, _)| *line)
    }

    fn fault(&self, expected: &str) -> FileError {
        let found = self.peek().map_or("the file ends".to_owned(), |word| format!("found {word:?}"));
        error(self.line(), &found, expected)
    }

    fn expect(&mut self, word: &str) -> Result<(), FileError> {
        if self.peek().is_some_and(|w| w.eq_ignore_ascii_case(word)) {
            self.at += 1;
            return Ok(());
        }
        Err(self.fault(&format!("{word:?}")))
    }

    /// Takes the next word as what `parse` makes of it.
    fn next<T>(&mut self, expected: &str, parse: impl Fn(&'a str) -> Option<T>) -> Result<T, FileError> {
        let parsed = self.peek().and_then(parse).ok_or_else(|| self.fault(expected))?;
        self.at += 1;
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
        return Err(error(1, &format!("the text has {} bytes", text.len()), &format!("{LARGEST_BYTES} at most")));
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
        words.at -= 1;
        return Err(words.fault("0.0001 to 1 s from frame to frame"));
    }
    let wide: usize = joints.iter().map(|j| j.channels.len()).sum();
    let frames = frames(&mut words, count, wide)?;
    Ok(Bvh { joints, frame_time_s, frames })
}

/// Parses the joints, parents first.
fn hierarchy(words: &mut Words) -> Result<Vec<BvhJoint>, FileError> {
    words.expect("HIERARCHY")?;
    words.expect("ROOT")?;
    let mut joints: Vec<BvhJoint> = Vec::new();
    // Joints whose braces are not closed yet.
    let mut open: Vec<usize> = Vec::new();
    let mut name = joint_name(words);
    loop {
        if joints.len() >= MOST_JOINTS {
            return Err(words.fault(&format!("at most {MOST_JOINTS} joints")));
        }
        words.expect("{")?;
        let end_site = name.is_empty();
        let offset = words.offset()?;
        let channels = if end_site { Vec::new() } else { channels(words)? };
        joints.push(BvhJoint { name: std::mem::take(&mut name), parent: open.last().copied(), offset, channels });
        open.push(joints.len() - 1);
        if end_site {
            words.expect("}")?;
            open.pop();
        }
        while words.peek() == Some("}") && !open.is_empty() {
            words.at += 1;
            open.pop();
        }
        if open.is_empty() {
            return Ok(joints);
        }
        match words.next("JOINT, End Site or }", Some)? {
            word if word.eq_ignore_ascii_case("JOINT") => name = joint_name(words),
            word if word.eq_ignore_ascii_case("End") => words.expect("Site")?,
            _ => {
                words.at -= 1;
                return Err(words.fault("JOINT, End Site or }"));
            }
        }
        if name.is_empty() && words.peek() != Some("{") {
            return Err(words.fault("{"));
        }
    }
}

/// Parses `count` frames of `wide` numbers, one frame a line. The text must end after the last frame.
fn frames(words: &mut Words, count: usize, wide: usize) -> Result<Vec<Vec<f64>>, FileError> {
    if count.saturating_mul(wide) > MOST_NUMBERS {
        return Err(words.fault(&format!("at most {MOST_NUMBERS} numbers in all")));
    }
    if wide == 0 && count > 0 {
        let found = format!("{count} frames of a skeleton without channels");
        return Err(error(words.line(), &found, "a joint with channels"));
    }
    // No memory is reserved for frames that the text may not contain.
    let mut frames = Vec::new();
    for frame in 0..count {
        let begins = words.line();
        let expected = format!("{wide} finite numbers for frame {frame} of {count}");
        let row = (0..wide).map(|_| words.number(&expected)).collect::<Result<Vec<f64>, FileError>>()?;
        // A line that is too short would take its numbers from the next line.
        let ends = words.all.get(words.at - 1).map_or(begins, |(line, _)| *line);
        if ends != begins {
            let found = format!("frame {frame} has too few numbers");
            return Err(error(begins, &found, &format!("{wide} on its line")));
        }
        frames.push(row);
    }
    if words.peek().is_some() {
        return Err(words.fault(&format!("the end of the file after {count} frames of {wide} numbers")));
    }
    Ok(frames)
}

/// Parses a joint's name, which may contain blanks.
fn joint_name(words: &mut Words) -> String {
    let line = words.line();
    let mut parts = Vec::new();
    while let Some(word) = words.peek().filter(|w| *w != "{" && words.line() == line) {
        parts.push(word);
        words.at += 1;
    }
    if parts.is_empty() { "joint".to_owned() } else { parts.join(" ") }
}

fn channels(words: &mut Words) -> Result<Vec<Channel>, FileError> {
    words.expect("CHANNELS")?;
    let count = words.count("the number of channels")?;
    if count > 6 {
        words.at -= 1;
        return Err(words.fault("at most 6 channels"));
    }
    let channel = |word: &str| CHANNELS.iter().find(|(name, _)| name.eq_ignore_ascii_case(word)).map(|(_, c)| *c);
    (0..count).map(|_| words.next("Xposition, Yrotation or the like", channel)).collect()
}

impl Bvh {
    /// Returns the positions of the joints in a frame, in the file's unit and axes. Without a frame, returns the rest
    /// pose.
    pub fn places(&self, frame: Option<usize>) -> Vec<DVec3> {
        let mut numbers = frame.and_then(|f| self.frames.get(f)).into_iter().flatten();
        let mut world: Vec<(DVec3, DMat3)> = Vec::with_capacity(self.joints.len());
        for joint in &self.joints {
            let (place, turned) =
                joint.parent.and_then(|p| world.get(p).copied()).unwrap_or((DVec3::ZERO, DMat3::IDENTITY));
            let (mut offset, mut turn) = (joint.offset, DMat3::IDENTITY);
            for channel in &joint.channels {
                let Some(&number) = numbers.next() else { break };
                match *channel {
                    Channel::Position(axis) => offset[axis] = number,
                    Channel::Rotation(0) => turn *= DMat3::from_rotation_x(number.to_radians()),
                    Channel::Rotation(1) => turn *= DMat3::from_rotation_y(number.to_radians()),
                    Channel::Rotation(_) => turn *= DMat3::from_rotation_z(number.to_radians()),
                }
            }
            world.push((place + turned * offset, turned * turn));
        }
        world.into_iter().map(|(place, _)| place).collect()
    }
}
