//! Reader of glTF 2.0: a tree of nodes, their meshes, and numbers in buffers. Every access to a buffer is
//! bounds-checked.

use std::borrow::Cow;
use std::cell::Cell;
use std::path::Path;

use base64::Engine;
use glam::{DMat4, DVec3};
use gltf::accessor::DataType;
use gltf::json::validation::Validate;
use gltf::mesh::Mode;
use radome_files::{MESH_LIMIT_BYTES, beside, read};

use super::{Damage, Mesh, ParseError, Part};

/// Largest number of objects in a file's JSON: each takes up to a kilobyte of memory for two bytes of text.
const MOST_OBJECTS: usize = 200_000;
/// Largest number of values in lists and objects: each takes up to 32 bytes of memory.
const MOST_VALUES: usize = 8_000_000;
/// Largest number of values read from all accessors together: many primitives may name the same accessor.
const MOST_NUMBERS: usize = 1 << 25;
/// Length of a GLB file's header, which is included in the length that it states.
const GLB_HEADER_BYTES: u32 = 12;

/// A parsed file and its buffers.
pub(crate) struct GltfFile {
    pub document: gltf::Document,
    buffers: Vec<Vec<u8>>,
    /// Number of values read from accessors so far.
    values_read: Cell<usize>,
}

/// Numbers of an accessor, in rows of `width` numbers.
pub(crate) struct Rows {
    pub width: usize,
    pub numbers: Vec<f64>,
}

impl Rows {
    /// Iterates over rows of `N` numbers.
    pub fn of<const N: usize>(&self) -> impl Iterator<Item = [f64; N]> {
        self.numbers.as_chunks::<N>().0.iter().copied()
    }

    pub fn vectors(&self) -> Vec<DVec3> {
        self.of::<3>().map(DVec3::from).collect()
    }
}

impl GltfFile {
    /// Parses a `.glb`, or a `.gltf` whose buffers are embedded or in files in `folder`.
    ///
    /// # Errors
    /// [`Damage`] if the file is malformed, or one of its buffers is absent, too short or too large.
    pub fn parse(bytes: &[u8], folder: &Path) -> Result<Self, Damage> {
        let (document, mut blob) = document(bytes)?;
        let mut buffers = Vec::new();
        // The limit for one file applies to all buffer files together.
        let mut left_bytes = MESH_LIMIT_BYTES;
        for buffer in document.buffers() {
            let place = format!("buffer {}", buffer.index());
            let bytes = match buffer.source() {
                gltf::buffer::Source::Bin => {
                    blob.take().ok_or_else(|| Damage::new(&place, "the file has no binary part, expected one"))?
                }
                gltf::buffer::Source::Uri(uri) => match uri.strip_prefix("data:") {
                    Some(data) => {
                        let text = data.split_once("base64,").map_or("", |(_, text)| text);
                        let decoded = base64::engine::general_purpose::STANDARD.decode(text.trim());
                        decoded.map_err(|e| Damage::new(&place, format!("its data is no base64: {e}")))?
                    }
                    None => {
                        let bytes = beside(folder, uri).and_then(|path| read(&path, left_bytes)).map_err(|e| {
                            let reason = e.to_string();
                            let reason = reason.split("\n\nhint: ").next().unwrap_or_default();
                            Damage::new(&place, format!("{uri:?} beside the file cannot be read: {reason}"))
                        })?;
                        left_bytes = left_bytes.saturating_sub(bytes.len() as u64);
                        bytes
                    }
                },
            };
            if bytes.len() < buffer.length() {
                let problem =
                    format!("it has {} bytes, expected {}: the file is cut off", bytes.len(), buffer.length());
                return Err(Damage::new(place, problem));
            }
            buffers.push(bytes);
        }
        Ok(GltfFile { document, buffers, values_read: Cell::new(0) })
    }

    /// Numbers of an accessor; normalised integers are converted to fractions.
    ///
    /// # Errors
    /// [`Damage`] if the accessor has no buffer, or exceeds it.
    pub fn rows(&self, accessor: &gltf::Accessor, what: &str) -> Result<Rows, Damage> {
        let place = format!("accessor {} ({what})", accessor.index());
        if accessor.sparse().is_some() {
            return Err(Damage::new(place, "it is sparse, expected all its values: export without sparse accessors"));
        }
        let view = accessor.view().ok_or_else(|| Damage::new(&place, "it has no buffer view"))?;
        let (width, size) = (accessor.dimensions().multiplicity(), accessor.data_type().size());
        let bytes = self.buffers.get(view.buffer().index()).map(Vec::as_slice).unwrap_or_default();
        let stride = view.stride().unwrap_or(width * size).max(1);
        let first = view.offset().saturating_add(accessor.offset());
        let length = accessor.count().saturating_sub(1).saturating_mul(stride).saturating_add(width * size);
        let view_end = (view.offset().saturating_add(view.length())).min(bytes.len());
        if accessor.count() > 0 && first.saturating_add(length) > view_end {
            let problem =
                format!("it reaches to byte {}, but its view ends at {view_end}", first.saturating_add(length));
            return Err(Damage::new(place, problem));
        }
        let values_read = self.values_read.get().saturating_add(accessor.count().saturating_mul(width));
        if values_read > MOST_NUMBERS {
            let problem =
                format!("the file's accessors have more than {MOST_NUMBERS} numbers together: reduce the mesh");
            return Err(Damage::new(place, problem));
        }
        self.values_read.set(values_read);
        let mut numbers = Vec::with_capacity(accessor.count() * width);
        for row in 0..accessor.count() {
            for column in 0..width {
                let at = first + row * stride + column * size;
                let bytes = bytes.get(at..at + size).unwrap_or_default();
                numbers.push(number(bytes, accessor.data_type(), accessor.normalized()));
            }
        }
        Ok(Rows { width, numbers })
    }

    /// Nodes with their parents, parents first.
    ///
    /// # Errors
    /// [`Damage`] if the nodes are not a tree.
    pub fn tree(&self) -> Result<Vec<(usize, Option<usize>)>, Damage> {
        let count = self.document.nodes().count();
        let mut parents: Vec<Option<usize>> = vec![None; count];
        for node in self.document.nodes() {
            for child in node.children() {
                let slot = parents.get_mut(child.index());
                if let Some(slot @ None) = slot {
                    *slot = Some(node.index());
                } else {
                    return Err(Damage::new(format!("node {}", child.index()), "it has two parents, expected a tree"));
                }
            }
        }
        let mut order: Vec<(usize, Option<usize>)> =
            (0..count).filter(|&n| parents[n].is_none()).map(|n| (n, None)).collect();
        let mut visited = 0;
        while let Some(&(index, _)) = order.get(visited) {
            visited += 1;
            let node = self.document.nodes().nth(index);
            order.extend(node.iter().flat_map(|node| node.children()).map(|child| (child.index(), Some(index))));
        }
        if order.len() < count {
            return Err(Damage::new("nodes", "some are their own ancestors, expected a tree"));
        }
        Ok(order)
    }

    /// Positions and triangles of a primitive; empty for points and lines.
    ///
    /// # Errors
    /// [`Damage`] if its positions or indices cannot be read.
    pub fn triangles(&self, primitive: &gltf::Primitive, what: &str) -> Result<Mesh, Damage> {
        let mode = primitive.mode();
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            return Ok(Mesh::default());
        }
        let Some(positions) = primitive.get(&gltf::Semantic::Positions) else {
            return Err(Damage::new(what, "it has no positions"));
        };
        let vertices = self.rows(&positions, &format!("positions of {what}"))?.vectors();
        let indices: Vec<u32> = match primitive.indices() {
            Some(indices) => {
                let rows = self.rows(&indices, &format!("indices of {what}"))?;
                rows.numbers.iter().map(|&i| i as u32).collect()
            }
            None => (0..vertices.len() as u32).collect(),
        };
        let triangles = match mode {
            // Every second triangle of a strip is wound the other way.
            Mode::TriangleStrip => {
                let all = indices.windows(3).enumerate();
                all.map(|(i, t)| if i.is_multiple_of(2) { [t[0], t[1], t[2]] } else { [t[1], t[0], t[2]] }).collect()
            }
            Mode::TriangleFan => indices.windows(2).skip(1).map(|pair| [indices[0], pair[0], pair[1]]).collect(),
            _ => indices.as_chunks::<3>().0.to_vec(),
        };
        Ok(Mesh { vertices, triangles })
    }
}

/// Parses and validates the document of a `.gltf` or `.glb`. Also returns the binary part of a `.glb`.
fn document(bytes: &[u8]) -> Result<(gltf::Document, Option<Vec<u8>>), Damage> {
    let (text, blob) = if bytes.starts_with(b"glTF") {
        let stated = bytes.get(8..12).and_then(|length| length.try_into().ok()).map_or(0, u32::from_le_bytes);
        if stated < GLB_HEADER_BYTES {
            let problem = format!("its header states {stated} bytes, expected {GLB_HEADER_BYTES} or more");
            return Err(Damage::new("glTF", problem));
        }
        let glb = gltf::Glb::from_slice(bytes).map_err(|e| Damage::new("glTF", e.to_string()))?;
        (glb.json, glb.bin.map(Cow::into_owned))
    } else {
        (Cow::Borrowed(bytes), None)
    };
    // Data embedded in the text contains neither braces nor commas, except for one comma after its type.
    for (mark, what, most) in [(b'{', "objects", MOST_OBJECTS), (b',', "values", MOST_VALUES)] {
        let count = text.iter().filter(|&&byte| byte == mark).count();
        if count > most {
            return Err(Damage::new("glTF", format!("its document has {count} {what}, expected {most} at most")));
        }
    }
    let root: gltf::json::Root =
        gltf::json::deserialize::from_slice(&text).map_err(|e| Damage::new("glTF", e.to_string()))?;
    // The library accesses the accessors of positions before it checks that they exist.
    for (index, primitive) in root.meshes.iter().flat_map(|mesh| &mesh.primitives).enumerate() {
        if let Some(accessor) = primitive.attributes.values().find(|accessor| accessor.value() >= root.accessors.len())
        {
            let (accessor, count) = (accessor.value(), root.accessors.len());
            let problem = format!("it names accessor {accessor}, but there are {count}: index out of bounds");
            return Err(Damage::new(format!("glTF primitive {index}"), problem));
        }
    }
    // Only the first error is kept: there may be one for each number.
    let mut invalid = None;
    let mut report = |path: &dyn Fn() -> gltf::json::Path, error: gltf::json::validation::Error| {
        if invalid.is_none() {
            invalid = Some(format!("{}: {error}", path()));
        }
    };
    root.validate(&root, gltf::json::Path::new, &mut report);
    // The library checks everything except the targets of animation channels, and panics if these are invalid.
    for (index, animation) in root.animations.iter().enumerate() {
        for (number, channel) in animation.channels.iter().enumerate() {
            let path = || gltf::json::Path::new().field("animations").index(index).field("channels").index(number);
            channel.target.validate(&root, || path().field("target"), &mut report);
        }
    }
    match invalid {
        Some(problem) => Err(Damage::new("glTF", problem)),
        None => Ok((gltf::Document::from_json_without_validation(root), blob)),
    }
}

/// Decodes a little-endian number of an accessor; a normalised integer is converted to a fraction.
fn number(bytes: &[u8], kind: DataType, normalised: bool) -> f64 {
    let le = |n: usize| bytes.iter().take(n).rev().fold(0u32, |sum, &b| sum << 8 | u32::from(b));
    let (value, largest) = match kind {
        DataType::I8 => (f64::from(le(1) as u8 as i8), 127.0),
        DataType::U8 => (f64::from(le(1)), 255.0),
        DataType::I16 => (f64::from(le(2) as u16 as i16), 32767.0),
        DataType::U16 => (f64::from(le(2)), 65535.0),
        DataType::U32 => (f64::from(le(4)), 1.0),
        DataType::F32 => return f64::from(f32::from_bits(le(4))),
    };
    if normalised { (value / largest).max(-1.0) } else { value }
}

/// Parses the static content of a glTF file: a part for each primitive of each node that has a mesh, placed by its
/// node. Only nodes of the default scene count, or of the first one; all nodes if the file has no scene.
pub(super) fn parse_gltf(bytes: &[u8], folder: &Path) -> Result<Vec<Part>, ParseError> {
    let file = GltfFile::parse(bytes, folder)?;
    let mut world_from_node: Vec<DMat4> = vec![DMat4::IDENTITY; file.document.nodes().count()];
    let scene = file.document.default_scene().or_else(|| file.document.scenes().next());
    let mut is_in_scene = vec![scene.is_none(); world_from_node.len()];
    scene.iter().flat_map(|scene| scene.nodes()).for_each(|root| is_in_scene[root.index()] = true);
    let mut parts = Vec::new();
    for (node, parent) in file.tree()? {
        let Some(node) = file.document.nodes().nth(node) else { continue };
        is_in_scene[node.index()] |= parent.is_some_and(|parent| is_in_scene[parent]);
        let local = DMat4::from_cols_array_2d(&node.transform().matrix().map(|c| c.map(f64::from)));
        let matrix = parent.map_or(DMat4::IDENTITY, |p| world_from_node[p]) * local;
        world_from_node[node.index()] = matrix;
        if !is_in_scene[node.index()] {
            continue;
        }
        for primitive in node.mesh().iter().flat_map(|m| m.primitives()) {
            let name = node.name().unwrap_or_default().to_owned();
            let mut mesh = file.triangles(&primitive, &format!("mesh of node {name:?}"))?;
            mesh.check_unscaled()?;
            mesh.vertices.iter_mut().for_each(|v| *v = matrix.transform_point3(*v));
            // A mirroring transform reverses the winding.
            if matrix.determinant() < 0.0 {
                mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
            }
            if !mesh.triangles.is_empty() {
                parts.push(Part { name, material: primitive.material().name().map(str::to_owned), mesh });
            }
        }
    }
    if parts.is_empty() { Err(ParseError::Empty) } else { Ok(parts) }
}
