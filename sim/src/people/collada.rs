//! Skinned actors from COLLADA 1.4 and 1.5 files (`.dae`).
//!
//! The reader takes the unit and the up axis, polygons and skins. It also takes the tree of nodes with all kinds of
//! transforms, and the animations of these transforms. All animations of a file form one clip. Curves between keyframes
//! become straight lines.

use std::borrow::Cow;
use std::cell::Cell;
use std::collections::{BTreeMap, HashMap};

use glam::{DAffine3, DMat4, DQuat, DVec3};
use roxmltree::{Document, Node as Element, ParsingOptions};

use super::rig::{Clip, Joint, KeyInterpolation, KeyframeTrack, KeyframeValues, LocalTransform, MOST_NODES, Node, Rig};
use crate::file_error::{FileError, utf8};
use crate::geometry::import::UpAxis;

/// Greatest depth of a tree.
const MOST_DEPTH: usize = 256;
/// Upper limit of a document's size, bytes: in memory, an attribute takes ten times as much as in the file.
const LARGEST_BYTES: usize = 64 << 20;
/// Upper limit of elements and texts in a document.
const MOST_ELEMENTS: u32 = 1_000_000;
/// Upper limit of numbers and names read from a document: a skin may be referenced any number of times.
const MOST_NUMBERS: usize = 1 << 25;
/// Largest offset of an input among the indices of a corner. Files have only a few inputs.
const LARGEST_OFFSET: usize = 255;
/// Upper limits for one node: number of curves over its transforms, and number of keyframes of all curves together.
const MOST_CURVES: usize = 64;
const MOST_KEYS: usize = 100_000;

/// One of the transforms that a node is made of.
#[derive(Clone)]
struct Transform {
    sid: String,
    kind: TransformKind,
    numbers: Vec<f64>,
}

#[derive(Clone, Copy, PartialEq)]
enum TransformKind {
    Matrix,
    Translate,
    Rotate,
    Scale,
}

/// Identifiers and transforms of a node.
struct NodeTransforms {
    id: String,
    sid: String,
    transforms: Vec<Transform>,
}

/// A curve that animates one number, or all numbers, of one of a node's transforms.
struct Curve {
    /// Index of the transform.
    transform: usize,
    /// First of the animated numbers, and their count.
    member: usize,
    width: usize,
    times_s: Vec<f64>,
    values: Vec<f64>,
    /// Whether each value holds until the next keyframe.
    is_stepped: bool,
}

struct Reader<'d, 'a> {
    doc: &'d Document<'a>,
    /// Elements by id. If several share an id, the first one is kept.
    ids: HashMap<&'d str, Element<'d, 'a>>,
    /// Numbers and names that may still be read.
    remaining: Cell<usize>,
}

/// Parses a COLLADA file.
pub(super) fn parse_collada(bytes: &[u8]) -> Result<Rig, FileError> {
    let export = "export the actor again as COLLADA 1.4, or as glTF 2.0";
    let text = utf8(bytes, export)?;
    if bytes.len() > LARGEST_BYTES {
        let problem = format!("it has {} bytes, expected {LARGEST_BYTES} at most", bytes.len());
        return Err(FileError::new("file", problem, "export it again as binary glTF 2.0 (.glb)"));
    }
    let options = ParsingOptions { nodes_limit: MOST_ELEMENTS, ..ParsingOptions::default() };
    let doc = Document::parse_with_options(text, options)
        .map_err(|e| FileError::new(format!("line {}", e.pos().row), format!("no XML: {e}"), export))?;
    let mut ids = HashMap::new();
    for element in doc.descendants() {
        if let Some(id) = element.attribute("id") {
            ids.entry(id).or_insert(element);
        }
    }
    let reader = Reader { doc: &doc, ids, remaining: Cell::new(MOST_NUMBERS) };
    let root = reader.doc.root_element();
    if root.tag_name().name() != "COLLADA" {
        return Err(reader.error(root, format!("the document is a {:?}, expected COLLADA", root.tag_name().name())));
    }
    let mut rig = Rig { unit_m: 1.0, up: UpAxis::Y, ..Rig::default() };
    for element in root.descendants() {
        match element.tag_name().name() {
            "unit" => rig.unit_m = reader.unit_m(element)?,
            "up_axis" => rig.up = reader.up_axis(element)?,
            _ => {}
        }
    }
    let mut nodes = Vec::new();
    for scene in reader.elements("visual_scene") {
        for node in scene.children().filter(|c| c.has_tag_name("node")) {
            reader.add_node(&mut rig, &mut nodes, node, None, 0)?;
        }
    }
    for controller in reader.elements("instance_controller") {
        let url = controller.attribute("url").unwrap_or_default();
        let skin = reader.referenced(controller, url)?.descendants().find(|d| d.has_tag_name("skin"));
        let skin = skin.ok_or_else(|| reader.error(controller, format!("{url:?} has no skin, expected one")))?;
        reader.add_skin(&mut rig, &nodes, skin)?;
    }
    reader.add_clip(&mut rig, &nodes)?;
    Ok(rig)
}

fn child<'d, 'a>(parent: Element<'d, 'a>, name: &str) -> Option<Element<'d, 'a>> {
    parent.children().find(|c| c.has_tag_name(name))
}

fn input<'d, 'a>(parent: Element<'d, 'a>, semantic: &str) -> Option<Element<'d, 'a>> {
    parent.children().find(|c| c.has_tag_name("input") && c.attribute("semantic") == Some(semantic))
}

impl<'d, 'a> Reader<'d, 'a> {
    /// Error at the line of an element.
    fn error(&self, at: Element, problem: impl Into<String>) -> FileError {
        let line = self.doc.text_pos_at(at.range().start).row;
        FileError::new(format!("line {line}"), problem, "export the actor again as COLLADA 1.4, or as glTF 2.0")
    }

    /// All elements with a tag name, in the order of the document.
    fn elements(&self, name: &'static str) -> impl Iterator<Item = Element<'d, 'a>> {
        self.doc.descendants().filter(move |d| d.has_tag_name(name))
    }

    /// Subtracts words that are about to be read from the limit. Fails if the limit is exceeded.
    fn take_from_limit(&self, element: Element, words: usize) -> Result<(), FileError> {
        let remaining = self.remaining.get().checked_sub(words);
        let problem = || self.error(element, format!("the document has more than {MOST_NUMBERS} numbers in all"));
        remaining.map(|remaining| self.remaining.set(remaining)).ok_or_else(problem)
    }

    /// Position of an input's index among the indices of a corner; `None` where the file does not give it.
    fn offset(&self, input: Element) -> Result<Option<usize>, FileError> {
        let Some(text) = input.attribute("offset") else { return Ok(None) };
        match text.trim().parse::<usize>() {
            Ok(offset) if offset <= LARGEST_OFFSET => Ok(Some(offset)),
            _ => Err(self.error(input, format!("offset is {text:?}, expected 0 to {LARGEST_OFFSET}"))),
        }
    }

    /// Returns the element to which a reference points.
    fn referenced(&self, at: Element, url: &str) -> Result<Element<'d, 'a>, FileError> {
        let id = url.trim_start_matches('#');
        self.ids
            .get(id)
            .copied()
            .ok_or_else(|| self.error(at, format!("{url:?} is nowhere, expected an element of that id")))
    }

    /// Length of the file's unit in metres.
    fn unit_m(&self, unit: Element) -> Result<f64, FileError> {
        let given = unit.attribute("meter");
        let unit_m = given.unwrap_or("1").parse::<f64>().ok().filter(|m| *m > 0.0 && m.is_finite());
        unit_m.ok_or_else(|| self.error(unit, format!("meter is {given:?}, expected a positive number")))
    }

    fn up_axis(&self, element: Element) -> Result<UpAxis, FileError> {
        match element.text().unwrap_or_default().trim() {
            "Y_UP" => Ok(UpAxis::Y),
            "Z_UP" => Ok(UpAxis::Z),
            other => Err(self.error(element, format!("up_axis is {other:?}, expected Y_UP or Z_UP"))),
        }
    }

    /// Returns the first child with a name, or an error if there is none.
    fn required_child<'e, 'x>(
        &self,
        parent: Element<'e, 'x>,
        name: &str,
        problem: impl Into<String>,
    ) -> Result<Element<'e, 'x>, FileError> {
        child(parent, name).ok_or_else(|| self.error(parent, problem))
    }

    /// Parses the words of an element's text.
    fn words<T>(
        &self,
        element: Element,
        expected: &str,
        parse: impl Fn(&str) -> Option<T>,
    ) -> Result<Vec<T>, FileError> {
        let text = element.text().unwrap_or_default();
        self.take_from_limit(element, text.split_whitespace().count())?;
        let parsed = |word: &str| {
            let problem = || format!("{word:?} in {:?}, expected {expected}", element.tag_name().name());
            parse(word).ok_or_else(|| self.error(element, problem()))
        };
        text.split_whitespace().map(parsed).collect()
    }

    fn numbers(&self, element: Element) -> Result<Vec<f64>, FileError> {
        self.words(element, "finite numbers", |word| word.parse().ok().filter(|n: &f64| n.is_finite()))
    }

    fn counts(&self, element: Element) -> Result<Vec<usize>, FileError> {
        self.words(element, "indices", |word| word.parse().ok())
    }

    /// Returns the source that the input with a semantic refers to.
    fn source(&self, parent: Element, semantic: &str) -> Result<Element<'d, 'a>, FileError> {
        let input = input(parent, semantic).ok_or_else(|| {
            self.error(parent, format!("{:?} has no input of the semantic {semantic}", parent.tag_name().name()))
        })?;
        self.referenced(input, input.attribute("source").unwrap_or_default())
    }

    /// Reads the numbers of a source.
    fn floats(&self, source: Element) -> Result<Vec<f64>, FileError> {
        self.numbers(self.required_child(source, "float_array", "the source has no float_array, expected one")?)
    }

    fn names(&self, source: Element) -> Result<Vec<String>, FileError> {
        let is_names = |c: &Element| c.has_tag_name("Name_array") || c.has_tag_name("IDREF_array");
        let array = source.children().find(is_names);
        let array = array.ok_or_else(|| self.error(source, "the source has no Name_array"))?;
        self.words(array, "names", |word| Some(word.to_owned()))
    }

    fn add_node(
        &self,
        rig: &mut Rig,
        nodes: &mut Vec<NodeTransforms>,
        node: Element,
        parent: Option<usize>,
        depth: usize,
    ) -> Result<(), FileError> {
        if depth > MOST_DEPTH {
            return Err(self.error(node, format!("nodes are nested more than {MOST_DEPTH} deep")));
        }
        if rig.nodes.len() >= MOST_NODES {
            return Err(self.error(node, format!("there are more than {MOST_NODES} nodes")));
        }
        let mut transforms = Vec::new();
        for child in node.children().filter(|c| c.is_element()) {
            let (kind, width) = match child.tag_name().name() {
                "matrix" => (TransformKind::Matrix, 16),
                "translate" => (TransformKind::Translate, 3),
                "rotate" => (TransformKind::Rotate, 4),
                "scale" => (TransformKind::Scale, 3),
                other @ ("lookat" | "skew") => {
                    return Err(
                        self.error(child, format!("{other:?} is not read, expected matrix, translate, rotate, scale"))
                    );
                }
                _ => continue,
            };
            let numbers = self.numbers(child)?;
            if numbers.len() != width {
                return Err(self.error(child, format!("{} numbers, expected {width}", numbers.len())));
            }
            transforms.push(Transform { sid: child.attribute("sid").unwrap_or_default().to_owned(), kind, numbers });
        }
        let attribute = |name: &str| node.attribute(name).unwrap_or_default().to_owned();
        let name = [attribute("name"), attribute("id")].into_iter().find(|n| !n.is_empty()).unwrap_or_default();
        let index = rig.nodes.len();
        rig.nodes.push(Node { name, parent, local: LocalTransform::from_matrix(matrix(&transforms)) });
        nodes.push(NodeTransforms { id: attribute("id"), sid: attribute("sid"), transforms });
        for child in node.children().filter(|c| c.has_tag_name("node")) {
            self.add_node(rig, nodes, child, Some(index), depth + 1)?;
        }
        Ok(())
    }

    fn add_skin(&self, rig: &mut Rig, nodes: &[NodeTransforms], skin: Element) -> Result<(), FileError> {
        let required = |name: &str| self.required_child(skin, name, format!("the skin has no {name}, expected one"));
        let shape = match child(skin, "bind_shape_matrix") {
            Some(element) => {
                let numbers: [f64; 16] = self
                    .numbers(element)?
                    .try_into()
                    .map_err(|n: Vec<f64>| self.error(element, format!("{} numbers, expected 16", n.len())))?;
                DMat4::from_cols_array(&numbers).transpose()
            }
            None => DMat4::IDENTITY,
        };
        let (first_joint, first_vertex) = (rig.joints.len(), rig.vertices.len());
        self.add_joints(rig, nodes, required("joints")?)?;
        let weights = required("vertex_weights")?;
        self.add_weights(rig, weights, first_joint)?;
        let geometry = self.referenced(skin, skin.attribute("source").unwrap_or_default())?;
        self.add_geometry(rig, geometry, shape)?;
        if rig.vertices.len() != rig.weights.len() {
            let problem = format!(
                "{} vertices, but weights for {}",
                rig.vertices.len() - first_vertex,
                rig.weights.len() - first_vertex
            );
            return Err(self.error(weights, problem));
        }
        Ok(())
    }

    fn add_joints(&self, rig: &mut Rig, nodes: &[NodeTransforms], joints: Element) -> Result<(), FileError> {
        let names = self.names(self.source(joints, "JOINT")?)?;
        let inverse = self.floats(self.source(joints, "INV_BIND_MATRIX")?)?;
        let (found, count) = (inverse.len(), names.len());
        if found != 16 * count {
            let problem = format!("{found} numbers of inverse bind matrices for {count} joints, expected 16 each");
            return Err(self.error(joints, problem));
        }
        for (name, matrix) in names.iter().zip(inverse.as_chunks::<16>().0) {
            let by_sid = nodes.iter().position(|p| p.sid == *name);
            let node = by_sid.or_else(|| nodes.iter().position(|p| p.id == *name));
            let node = node.ok_or_else(|| self.error(joints, format!("joint {name:?} is no node of the scene")))?;
            rig.joints.push(Joint { node, inverse_bind: DMat4::from_cols_array(matrix).transpose() });
        }
        Ok(())
    }

    /// Adds the weights of vertices. Joint indices in the file are relative to the skin; `first_joint` is the
    /// first joint of the skin.
    fn add_weights(&self, rig: &mut Rig, weights: Element, first_joint: usize) -> Result<(), FileError> {
        let offset_of = |semantic: &str| {
            let offset = input(weights, semantic).map(|input| self.offset(input)).transpose()?.flatten();
            offset.ok_or_else(|| self.error(weights, format!("vertex_weights has no input {semantic} with an offset")))
        };
        let (joint_offset, weight_offset) = (offset_of("JOINT")?, offset_of("WEIGHT")?);
        let weight_values = self.floats(self.source(weights, "WEIGHT")?)?;
        let counts_of =
            |name: &str| self.counts(self.required_child(weights, name, format!("vertex_weights has no {name}"))?);
        let (counts, indices) = (counts_of("vcount")?, counts_of("v")?);
        let mut stride = 1 + joint_offset.max(weight_offset);
        for input in weights.children().filter(|c| c.has_tag_name("input")) {
            stride = stride.max(1 + self.offset(input)?.unwrap_or(0));
        }
        let weight_count = counts.iter().try_fold(0usize, |sum, &count| sum.checked_add(count));
        if weight_count.and_then(|count| count.checked_mul(stride)).is_none_or(|needed| needed > indices.len()) {
            let problem = format!(
                "vcount asks for {} weights of {stride} indices each, but there are {} indices",
                weight_count.map_or_else(|| "too many".to_owned(), |count| count.to_string()),
                indices.len()
            );
            return Err(self.error(weights, problem));
        }
        let mut begin = 0;
        for (vertex, count) in counts.into_iter().enumerate() {
            let mut vertex_weights = Vec::with_capacity(count);
            for _ in 0..count {
                let pair = (
                    indices.get(begin + joint_offset),
                    indices.get(begin + weight_offset).and_then(|&i| weight_values.get(i)),
                );
                let (Some(&joint), Some(&weight)) = pair else {
                    let problem = format!("weights of vertex {vertex} name numbers that are not there");
                    return Err(self.error(weights, problem));
                };
                vertex_weights.push((first_joint.saturating_add(joint), weight));
                begin += stride;
            }
            rig.weights.push(vertex_weights);
        }
        Ok(())
    }

    fn add_geometry(&self, rig: &mut Rig, geometry: Element, shape: DMat4) -> Result<(), FileError> {
        let mesh = self.required_child(geometry, "mesh", "the geometry is no mesh, expected one")?;
        let vertices = self.required_child(mesh, "vertices", "the mesh has no vertices")?;
        let first_vertex = rig.vertices.len() as u32;
        let floats = self.floats(self.source(vertices, "POSITION")?)?;
        rig.vertices.extend(floats.as_chunks::<3>().0.iter().map(|&p| shape.transform_point3(DVec3::from(p))));
        for faces in mesh.children().filter(|c| ["triangles", "polylist", "polygons"].contains(&c.tag_name().name())) {
            let (mut stride, mut vertex_offset) = (1, None);
            for input in faces.children().filter(|c| c.has_tag_name("input")) {
                let offset = self.offset(input)?.unwrap_or(0);
                stride = stride.max(1 + offset);
                if vertex_offset.is_none() && input.attribute("semantic") == Some("VERTEX") {
                    vertex_offset = Some(offset);
                }
            }
            let vertex_offset = vertex_offset.ok_or_else(|| self.error(faces, "the faces have no input VERTEX"))?;
            let are_polygons = faces.has_tag_name("polygons");
            let counts = child(faces, "vcount").map(|element| self.counts(element)).transpose()?;
            let index_lists = || faces.children().filter(|c| c.has_tag_name("p"));
            if counts.is_some() && index_lists().count() > 1 {
                return Err(self.error(faces, "faces with vcount have several lists of indices, expected one"));
            }
            for list in index_lists() {
                // An index that is too large is refused later, with the mesh.
                let index = |&v: &usize| u32::try_from(v).unwrap_or(u32::MAX);
                let corners: Vec<u32> =
                    self.counts(list)?.chunks(stride).filter_map(|c| c.get(vertex_offset)).map(index).collect();
                let counts = match &counts {
                    Some(counts) => Cow::Borrowed(counts),
                    None if are_polygons => Cow::Owned(vec![corners.len()]),
                    None => Cow::Owned(vec![3; corners.len() / 3]),
                };
                let mut begin = 0usize;
                for &count in counts.iter() {
                    let polygon = corners.get(begin..begin.saturating_add(count));
                    let polygon =
                        polygon.ok_or_else(|| self.error(list, "faces have more corners than there are indices"))?;
                    begin += count;
                    for pair in polygon.get(1..).unwrap_or_default().windows(2) {
                        rig.triangles.push([polygon[0], pair[0], pair[1]].map(|v| v.saturating_add(first_vertex)));
                    }
                }
            }
        }
        Ok(())
    }

    fn add_clip(&self, rig: &mut Rig, nodes: &[NodeTransforms]) -> Result<(), FileError> {
        let mut curves: BTreeMap<usize, Vec<Curve>> = BTreeMap::new();
        let mut by_id: HashMap<&str, usize> = HashMap::new();
        for (index, node) in nodes.iter().enumerate() {
            by_id.entry(node.id.as_str()).or_insert(index);
        }
        for channel in self.elements("channel") {
            let target = channel.attribute("target").unwrap_or_default();
            let Some((node, path)) = target.split_once('/') else { continue };
            let Some(&index) = by_id.get(node) else { continue };
            let of_node = curves.entry(index).or_default();
            of_node.push(self.curve(channel, target, path, &nodes[index].transforms)?);
            if of_node.windows(2).any(|curves| curves[0].is_stepped != curves[1].is_stepped) {
                let problem = format!(
                    "{target:?} and another curve of the node differ in INTERPOLATION, expected STEP for all or for none"
                );
                return Err(self.error(channel, problem));
            }
            let key_count: usize = of_node.iter().map(|curve| curve.times_s.len()).sum();
            if of_node.len() > MOST_CURVES || key_count > MOST_KEYS {
                let problem = format!(
                    "{target:?} and the node's other curves are more than {MOST_CURVES}, or have more than {MOST_KEYS} keys"
                );
                return Err(self.error(channel, problem));
            }
        }
        if !curves.is_empty() {
            let tracks = curves.iter().flat_map(|(&node, curves)| tracks(node, &nodes[node].transforms, curves));
            rig.clips.push(Clip { name: "animation".to_owned(), tracks: tracks.collect() });
        }
        Ok(())
    }

    /// Returns the curve by which a channel animates the transform of a node that `path` names.
    fn curve(&self, channel: Element, target: &str, path: &str, transforms: &[Transform]) -> Result<Curve, FileError> {
        let (sid, member) = path.split_once('.').map_or((path, None), |(sid, member)| (sid, Some(member)));
        let Some(transform) = transforms.iter().position(|s| s.sid == sid) else {
            return Err(self.error(channel, format!("{target:?} names no transform of the node")));
        };
        let number_count = transforms[transform].numbers.len();
        let (member, width) = match member {
            None => (0, number_count),
            Some("X") => (0, 1),
            Some("Y") => (1, 1),
            Some("Z") => (2, 1),
            Some("ANGLE") => (3, 1),
            Some(other) => {
                return Err(self.error(channel, format!("{other:?} is animated, expected X, Y, Z or ANGLE")));
            }
        };
        let sampler = self.referenced(channel, channel.attribute("source").unwrap_or_default())?;
        let times_s = self.floats(self.source(sampler, "INPUT")?)?;
        let values = self.floats(self.source(sampler, "OUTPUT")?)?;
        if times_s.is_empty() || values.len() != width * times_s.len() || member + width > number_count {
            let problem = format!("{} numbers for {} keys, expected {width} each", values.len(), times_s.len());
            return Err(self.error(sampler, problem));
        }
        if !times_s.windows(2).all(|times| times[0] < times[1]) {
            return Err(self.error(sampler, "key times do not ascend"));
        }
        let interpolations = self.source(sampler, "INTERPOLATION").and_then(|s| self.names(s)).unwrap_or_default();
        let is_stepped = interpolations.first().is_some_and(|b| b == "STEP");
        if interpolations.iter().any(|b| (b == "STEP") != is_stepped) {
            return Err(self.error(sampler, "INTERPOLATION is STEP for some keys, expected it for all or for none"));
        }
        Ok(Curve { transform, member, width, times_s, values, is_stepped })
    }
}

/// Returns the tracks of a node whose transforms follow curves, with the keyframes of all curves.
fn tracks(node: usize, transforms: &[Transform], curves: &[Curve]) -> [KeyframeTrack; 3] {
    let mut times_s: Vec<f64> = curves.iter().flat_map(|c| &c.times_s).copied().collect();
    times_s.sort_by(f64::total_cmp);
    times_s.dedup_by(|a, b| *a - *b < 1e-6);
    let local_at = |time_s: f64| {
        let mut transforms = transforms.to_vec();
        for curve in curves {
            let animated = transforms.get_mut(curve.transform);
            let animated = animated.and_then(|s| s.numbers.get_mut(curve.member..curve.member + curve.width));
            animated.into_iter().flatten().zip(curve.at(time_s)).for_each(|(number, value)| *number = value);
        }
        LocalTransform::from_matrix(matrix(&transforms))
    };
    let locals: Vec<LocalTransform> = times_s.iter().map(|&t| local_at(t)).collect();
    let interpolation =
        if curves.iter().all(|c| c.is_stepped) { KeyInterpolation::Step } else { KeyInterpolation::Linear };
    let values = [
        KeyframeValues::Translation(locals.iter().map(|l| l.translation).collect()),
        KeyframeValues::Rotation(locals.iter().map(|l| l.rotation).collect()),
        KeyframeValues::Scale(locals.iter().map(|l| l.scale).collect()),
    ];
    values.map(|values| KeyframeTrack { node, interpolation, times_s: times_s.clone(), values })
}

impl Curve {
    /// Animated numbers at a time.
    fn at(&self, time_s: f64) -> Vec<f64> {
        let after = self.times_s.partition_point(|&t| t <= time_s);
        let (before, after) = (after.saturating_sub(1), after.min(self.times_s.len() - 1));
        let (a, b) = (self.times_s[before], self.times_s[after]);
        let fraction = if b > a && !self.is_stepped { (time_s - a) / (b - a) } else { 0.0 };
        let key = |k: usize| &self.values[k * self.width..(k + 1) * self.width];
        key(before).iter().zip(key(after)).map(|(a, b)| a + (b - a) * fraction).collect()
    }
}

/// Product of a node's transforms, the first one outermost.
fn matrix(transforms: &[Transform]) -> DMat4 {
    transforms.iter().fold(DMat4::IDENTITY, |product, transform| {
        let numbers = &transform.numbers;
        let vector = || DVec3::new(numbers[0], numbers[1], numbers[2]);
        product
            * match transform.kind {
                TransformKind::Matrix => DMat4::from_cols_array(&std::array::from_fn(|i| numbers[i])).transpose(),
                TransformKind::Translate => DMat4::from_translation(vector()),
                TransformKind::Scale => DMat4::from_scale(vector()),
                TransformKind::Rotate => {
                    let turn = vector()
                        .try_normalize()
                        .map_or(DQuat::IDENTITY, |axis| DQuat::from_axis_angle(axis, numbers[3].to_radians()));
                    DAffine3::from_quat(turn).into()
                }
            }
    })
}
