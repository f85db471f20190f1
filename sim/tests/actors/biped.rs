//! Small person of boxes with two legs that walk, as a glTF, COLLADA or BVH file, generated in code.

use std::f64::consts::TAU;

use base64::Engine;
use serde_json::{Value, json};

/// Number of keys of the cycle; the last equals the first.
pub const KEYS: usize = 24;
/// Length of the cycle, s.
pub const CYCLE_S: f64 = 1.0;
/// Joints with their parents and positions, m, y up, facing +z (so that left is +x).
pub const JOINTS: [(&str, Option<usize>, [f64; 3]); 7] = [
    ("hips", None, [0.0, 0.9, 0.0]),
    ("thigh_left", Some(0), [0.1, 0.9, 0.0]),
    ("shank_left", Some(1), [0.1, 0.5, 0.0]),
    ("thigh_right", Some(0), [-0.1, 0.9, 0.0]),
    ("shank_right", Some(3), [-0.1, 0.5, 0.0]),
    ("arm_left", Some(0), [0.25, 1.4, 0.0]),
    ("arm_right", Some(0), [-0.25, 1.4, 0.0]),
];
/// Boxes: joint, low and high corner, m. Feet are ahead of their legs.
const BOXES: [(usize, [f64; 3], [f64; 3]); 10] = [
    (0, [-0.18, 0.9, -0.1], [0.18, 1.45, 0.1]),
    (0, [-0.08, 1.5, -0.1], [0.08, 1.75, 0.1]),
    (1, [0.04, 0.5, -0.06], [0.16, 0.9, 0.06]),
    (2, [0.05, 0.06, -0.05], [0.15, 0.5, 0.05]),
    (2, [0.05, 0.0, -0.08], [0.15, 0.06, 0.17]),
    (3, [-0.16, 0.5, -0.06], [-0.04, 0.9, 0.06]),
    (4, [-0.15, 0.06, -0.05], [-0.05, 0.5, 0.05]),
    (4, [-0.15, 0.0, -0.08], [-0.05, 0.06, 0.17]),
    (5, [0.2, 0.8, -0.04], [0.3, 1.4, 0.04]),
    (6, [-0.3, 0.8, -0.04], [-0.2, 1.4, 0.04]),
];

/// Rotation of a joint about +x at a phase, rad: positive moves a hanging limb backwards (towards -z).
pub fn joint_angle_rad(joint: usize, phase: f64) -> f64 {
    let leg = |phase: f64| -0.4 * (TAU * phase).cos();
    // Knees bend while their leg swings forward, in the second half of its cycle.
    let knee = |phase: f64| 1.0 * (-(TAU * phase).sin()).max(0.0).powi(2);
    match joint {
        1 => leg(phase),
        2 => knee(phase),
        3 => leg(phase + 0.5),
        4 => knee(phase + 0.5),
        5 => -leg(phase),
        6 => -leg(phase + 0.5),
        _ => 0.0,
    }
}

/// Vertices and the joint of each; eight per box.
pub fn vertices() -> Vec<([f64; 3], usize)> {
    let corner =
        |low: [f64; 3], high: [f64; 3], i: usize| [0, 1, 2].map(|a| if i >> a & 1 == 0 { low[a] } else { high[a] });
    BOXES.iter().flat_map(|&(joint, low, high)| (0..8).map(move |i| (corner(low, high, i), joint))).collect()
}

pub fn triangles() -> Vec<[u32; 3]> {
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let box_triangles =
        |b: u32| quads.into_iter().flat_map(move |[p, q, r, s]| [[p, q, r], [p, r, s]].map(|t| t.map(|v| v + 8 * b)));
    (0..BOXES.len() as u32).flat_map(box_triangles).collect()
}

fn local_position(joint: usize) -> [f64; 3] {
    let (_, parent, position) = JOINTS[joint];
    let parent_position = parent.map_or([0.0; 3], |p| JOINTS[p].2);
    [position[0] - parent_position[0], position[1] - parent_position[1], position[2] - parent_position[2]]
}

/// glTF document before it is written.
pub struct Gltf {
    pub json: Value,
    pub buffer: Vec<u8>,
}

impl Gltf {
    pub fn bytes(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        let data = base64::engine::general_purpose::STANDARD.encode(&self.buffer);
        json["buffers"][0]["uri"] = json!(format!("data:application/octet-stream;base64,{data}"));
        serde_json::to_vec(&json).expect("JSON")
    }

    fn add_accessor(&mut self, bytes: Vec<u8>, component_type: u32, element_type: &str, count: usize) -> usize {
        let offset = self.buffer.len();
        self.buffer.extend(&bytes);
        self.buffer.resize(self.buffer.len().next_multiple_of(4), 0);
        let list = |json: &mut Value, name: &str, value: Value| {
            let all = json[name].as_array_mut().expect("a list");
            all.push(value);
            all.len() - 1
        };
        let view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() });
        let view = list(&mut self.json, "bufferViews", view);
        let accessor =
            json!({ "bufferView": view, "componentType": component_type, "count": count, "type": element_type });
        let index = list(&mut self.json, "accessors", accessor);
        self.json["buffers"][0]["byteLength"] = json!(self.buffer.len());
        index
    }

    fn add_floats(&mut self, numbers: impl IntoIterator<Item = f64>, element_type: &str, width: usize) -> usize {
        let bytes: Vec<u8> = numbers.into_iter().flat_map(|n| (n as f32).to_le_bytes()).collect();
        let count = bytes.len() / 4 / width;
        self.add_accessor(bytes, 5126, element_type, count)
    }
}

/// The person as glTF, scaled by `size`.
pub fn gltf(size: f64) -> Gltf {
    let json = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0, 7] }],
        "buffers": [{}], "bufferViews": [], "accessors": [],
    });
    let mut file = Gltf { json, buffer: Vec::new() };
    let all = vertices();
    let position = file.add_floats(all.iter().flat_map(|(p, _)| p.map(|c| c * size)), "VEC3", 3);
    let (low, high) = (
        [0, 1, 2].map(|a| all.iter().map(|(p, _)| p[a] * size).fold(f64::INFINITY, f64::min)),
        [0, 1, 2].map(|a| all.iter().map(|(p, _)| p[a] * size).fold(f64::NEG_INFINITY, f64::max)),
    );
    (file.json["accessors"][position]["min"], file.json["accessors"][position]["max"]) = (json!(low), json!(high));
    let joints =
        file.add_accessor(all.iter().flat_map(|(_, j)| [*j as u8, 0, 0, 0]).collect(), 5121, "VEC4", all.len());
    let weights = file.add_floats(all.iter().flat_map(|_| [1.0, 0.0, 0.0, 0.0]), "VEC4", 4);
    let indices: Vec<u8> = triangles().iter().flatten().flat_map(|v| (*v as u16).to_le_bytes()).collect();
    let indices = file.add_accessor(indices, 5123, "SCALAR", 3 * triangles().len());
    let inverse = JOINTS.iter().flat_map(|(_, _, position)| {
        let [x, y, z] = position.map(|c| -c * size);
        [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, y, z, 1.0]
    });
    let inverse = file.add_floats(inverse.collect::<Vec<_>>(), "MAT4", 16);
    let times = file.add_floats((0..=KEYS).map(|k| CYCLE_S * k as f64 / KEYS as f64), "SCALAR", 1);
    (file.json["accessors"][times]["min"], file.json["accessors"][times]["max"]) = (json!([0.0]), json!([CYCLE_S]));
    let mut nodes: Vec<Value> = Vec::new();
    let (mut samplers, mut channels) = (Vec::new(), Vec::new());
    for (j, (name, ..)) in JOINTS.iter().enumerate() {
        let children: Vec<usize> = (0..JOINTS.len()).filter(|&c| JOINTS[c].1 == Some(j)).collect();
        let mut node = json!({ "name": name, "translation": local_position(j).map(|c| c * size) });
        if !children.is_empty() {
            node["children"] = json!(children);
        }
        nodes.push(node);
        let turns = (0..=KEYS).flat_map(|k| {
            let (sine, cosine) = (0.5 * joint_angle_rad(j, k as f64 / KEYS as f64)).sin_cos();
            [sine, 0.0, 0.0, cosine]
        });
        let turns = file.add_floats(turns.collect::<Vec<_>>(), "VEC4", 4);
        samplers.push(json!({ "input": times, "output": turns, "interpolation": "LINEAR" }));
        channels.push(json!({ "sampler": j, "target": { "node": j, "path": "rotation" } }));
    }
    nodes.push(json!({ "name": "person", "mesh": 0, "skin": 0 }));
    file.json["nodes"] = json!(nodes);
    file.json["skins"] = json!([{ "joints": (0..JOINTS.len()).collect::<Vec<_>>(), "inverseBindMatrices": inverse }]);
    let attributes = json!({ "POSITION": position, "JOINTS_0": joints, "WEIGHTS_0": weights });
    file.json["meshes"] = json!([{ "primitives": [{ "attributes": attributes, "indices": indices }] }]);
    file.json["animations"] = json!([{ "name": "walk", "samplers": samplers, "channels": channels }]);
    file
}

/// The person as COLLADA, in centimetres, with z up.
pub fn collada() -> String {
    // (x, y, z) with y up is (x, -z, y) with z up.
    let to_z_up_cm = |[x, y, z]: [f64; 3]| [100.0 * x, -100.0 * z, 100.0 * y];
    let joined = |numbers: Vec<f64>| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let all = vertices();
    let positions = joined(all.iter().flat_map(|(p, _)| to_z_up_cm(*p)).collect());
    let corners: Vec<String> = triangles().iter().flatten().map(u32::to_string).collect();
    let inverse = joined(
        JOINTS
            .iter()
            .flat_map(|(_, _, position)| {
                let [x, y, z] = to_z_up_cm(*position);
                [1.0, 0.0, 0.0, -x, 0.0, 1.0, 0.0, -y, 0.0, 0.0, 1.0, -z, 0.0, 0.0, 0.0, 1.0]
            })
            .collect(),
    );
    let names: Vec<&str> = JOINTS.iter().map(|j| j.0).collect();
    let pairs: Vec<String> = all.iter().map(|(_, j)| format!("{j} 0")).collect();
    let counts = vec!["1"; all.len()].join(" ");
    let times = joined((0..=KEYS).map(|k| CYCLE_S * k as f64 / KEYS as f64).collect());
    let mut animations = String::new();
    for (j, name) in names.iter().enumerate() {
        let degrees = joined((0..=KEYS).map(|k| joint_angle_rad(j, k as f64 / KEYS as f64).to_degrees()).collect());
        animations += &format!(
            "<animation><source id=\"{name}-in\"><float_array>{times}</float_array></source>\n\
             <source id=\"{name}-out\"><float_array>{degrees}</float_array></source>\n\
             <sampler id=\"{name}-sampler\"><input semantic=\"INPUT\" source=\"#{name}-in\"/>\
             <input semantic=\"OUTPUT\" source=\"#{name}-out\"/></sampler>\n\
             <channel source=\"#{name}-sampler\" target=\"{name}/turn.ANGLE\"/></animation>\n"
        );
    }
    fn node(j: usize, to_z_up_cm: &dyn Fn([f64; 3]) -> [f64; 3]) -> String {
        let (name, position) = (JOINTS[j].0, to_z_up_cm(local_position(j)));
        let children: String =
            (0..JOINTS.len()).filter(|&c| JOINTS[c].1 == Some(j)).map(|c| node(c, to_z_up_cm)).collect();
        format!(
            "<node id=\"{name}\" sid=\"{name}\" type=\"JOINT\">\n<translate sid=\"at\">{} {} {}</translate>\
             <rotate sid=\"turn\">1 0 0 0</rotate><scale>1 1 1</scale>\n{children}</node>\n",
            position[0], position[1], position[2]
        )
    }
    format!(
        "<?xml version=\"1.0\"?>\n<COLLADA xmlns=\"http://www.collada.org/2005/11/COLLADASchema\" version=\"1.4.1\">\n\
         <asset><unit name=\"centimeter\" meter=\"0.01\"/>\n<up_axis>Z_UP</up_axis></asset>\n\
         <library_geometries><geometry id=\"mesh\"><mesh>\n<source id=\"places\"><float_array>{positions}</float_array></source>\n\
         <vertices id=\"corners\"><input semantic=\"POSITION\" source=\"#places\"/></vertices>\n\
         <triangles count=\"{count}\"><input semantic=\"VERTEX\" source=\"#corners\" offset=\"0\"/><p>{corners}</p></triangles>\n\
         </mesh></geometry></library_geometries>\n\
         <library_controllers><controller id=\"skin\"><skin source=\"#mesh\">\n\
         <source id=\"joint-names\"><Name_array>{names}</Name_array></source>\n\
         <source id=\"inverse\"><float_array>{inverse}</float_array></source>\n\
         <source id=\"weights\"><float_array>1</float_array></source>\n\
         <joints><input semantic=\"JOINT\" source=\"#joint-names\"/><input semantic=\"INV_BIND_MATRIX\" source=\"#inverse\"/></joints>\n\
         <vertex_weights><input semantic=\"JOINT\" source=\"#joint-names\" offset=\"0\"/>\
         <input semantic=\"WEIGHT\" source=\"#weights\" offset=\"1\"/>\n<vcount>{counts}</vcount><v>{pairs}</v></vertex_weights>\n\
         </skin></controller></library_controllers>\n<library_animations>{animations}</library_animations>\n\
         <library_visual_scenes><visual_scene id=\"scene\">\n{root}\
         <node id=\"person\"><instance_controller url=\"#skin\"/></node>\n</visual_scene></library_visual_scenes>\n</COLLADA>\n",
        count = triangles().len(),
        corners = corners.join(" "),
        names = names.join(" "),
        pairs = pairs.join(" "),
        root = node(0, &to_z_up_cm),
    )
}

/// Clip of the walking person at 1.4 m/s: three cycles at 30 frames a second, in inches, y up, facing +z.
pub fn bvh() -> String {
    let inch = 1.0 / 0.0254;
    let limb = |side: &str, x: f64| {
        let inches_text = |v: [f64; 3]| v.map(|c| format!("{:.4}", c * inch)).join(" ");
        format!(
            "JOINT {side}UpLeg {{\n OFFSET {}\n CHANNELS 3 Zrotation Xrotation Yrotation\n JOINT {side}Leg {{\n  OFFSET {}\n  \
             CHANNELS 3 Zrotation Xrotation Yrotation\n  JOINT {side}Foot {{\n   OFFSET {}\n   CHANNELS 3 Zrotation Xrotation Yrotation\n   \
             End Site\n   {{\n    OFFSET {}\n   }}\n  }}\n }}\n}}\n",
            inches_text([x, 0.0, 0.0]),
            inches_text([0.0, -0.42, 0.0]),
            inches_text([0.0, -0.42, 0.0]),
            inches_text([0.0, -0.03, 0.15])
        )
    };
    let arm = |side: &str, x: f64| {
        let inches_text = |v: [f64; 3]| v.map(|c| format!("{:.4}", c * inch)).join(" ");
        format!(
            "JOINT {side}Arm {{\n OFFSET {}\n CHANNELS 3 Zrotation Xrotation Yrotation\n JOINT {side}ForeArm {{\n  OFFSET {}\n  \
             CHANNELS 3 Zrotation Xrotation Yrotation\n  JOINT {side}Hand {{\n   OFFSET {}\n   CHANNELS 3 Zrotation Xrotation Yrotation\n  }}\n }}\n}}\n",
            inches_text([x, 0.5, 0.0]),
            inches_text([0.0, -0.3, 0.0]),
            inches_text([0.0, -0.28, 0.0])
        )
    };
    let mut text = format!(
        "HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n{}{}{}{}}}\n",
        limb("Left", 0.1),
        limb("Right", -0.1),
        arm("Left", 0.2),
        arm("Right", -0.2)
    );
    let frames = 90;
    text += &format!("MOTION\nFrames: {frames}\nFrame Time: 0.0333333\n");
    for f in 0..frames {
        let phase = f as f64 / 30.0;
        let mut numbers = vec![0.0, 0.93 * inch, 1.4 * phase * inch, 0.0, 0.0, 0.0];
        for (thigh, knee) in [(1, 2), (3, 4)] {
            for degrees in
                [joint_angle_rad(thigh, phase), joint_angle_rad(knee, phase), -0.5 * joint_angle_rad(knee, phase)]
                    .map(f64::to_degrees)
            {
                numbers.extend([0.0, degrees, 0.0]);
            }
        }
        for arm in [5, 6] {
            numbers.extend([0.0, joint_angle_rad(arm, phase).to_degrees(), 0.0, 0.0, -20.0, 0.0, 0.0, 0.0, 0.0]);
        }
        text += &numbers.iter().map(|n| format!("{n:.4}")).collect::<Vec<_>>().join(" ");
        text += "\n";
    }
    text
}
