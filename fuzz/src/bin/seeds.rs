//! Writes the seed inputs of each fuzzer, made by the program's own encoders: `seeds FOLDER`.

use std::collections::BTreeMap;
use std::path::Path;

use radome_driver::protocol::ascii;
use radome_driver::protocol::mcu7::{
    BoardInfo, Command, FirmwareVersion, Packet, PacketFlags, Protocol, Response, SpiWord, Status,
};
use radome_driver::protocol::packed12::pack;
use radome_driver::recording::label_text::{to_audacity, to_deepcraft};
use radome_driver::recording::{Format, RecordingWriter};
use radome_driver::{LabelSpan, RecordingHeader};
use radome_dsp::{Frame, Gap, GapReason, MapFlags, Occupancy, Rdm, RdmSpec, Truth};
use radome_fuzz::{INFINEON_FILES, SEPARATOR, folder, waveform, with_card};
use radome_models::dataset::{DatasetHeader, DatasetWriter, Domain, ManifestRow};
use radome_models::layer::KernelLevel;
use radome_models::network::Network;
use radome_models::{Model, ModelCard};

#[path = "../../../sim/tests/actors/biped.rs"]
mod biped;

// All binaries of this crate are built with coverage and link only with a fuzz target. This one does nothing.
libfuzzer_sys::fuzz_target!(|_input: &[u8]| {});

type Seeds = Vec<Vec<u8>>;

fn commands() -> Vec<Command> {
    let words = vec![SpiWord::write(6, 0x10_0000), SpiWord::read(2)];
    vec![
        Command::BoardInfo,
        Command::BoardInfoFixed { length: 32 },
        Command::FirmwareVersion,
        Command::Uuid,
        Command::ExtendedVersion,
        Command::ComponentCount { component: 0x103 },
        Command::ComponentImplementation { component: 1 },
        Command::DataIndex,
        Command::WriteRegisters { address: 6, values: vec![0x10_0000] },
        Command::ReadRegisters { address: 2, count: 1 },
        Command::SetBits { address: 0, mask: 0xC },
        Command::HardwareReset,
        Command::Execute { words, answer: true },
        Command::ConfigureData { slice_samples: 6144 },
        Command::DataStatus,
        Command::StartData,
        Command::StopData,
    ]
}

fn strata_host() -> Seeds {
    let mut seeds = Vec::new();
    for protocol in Protocol::ALL {
        let all: Seeds = commands().iter().map(|c| c.to_request(protocol).encode()).collect();
        seeds.push(all.concat());
        seeds.extend(all);
    }
    let name = "Radar Baseboard MCU7 (MCU B)".to_owned();
    seeds.push(BoardInfo { vendor_id: 0x058B, product_id: 0x0251, name }.encode());
    seeds.push(FirmwareVersion { firmware: [2, 9, 0, 0], protocol: [4, 0] }.encode());
    let configuration = radome_driver::chip::ChipConfiguration { waveform: waveform(), slice_samples: 16 };
    let registers = configuration.compile().expect("compiles");
    let words = registers.iter().map(|r| (*r).into()).collect();
    seeds.push(Command::Execute { words, answer: false }.to_request(Protocol::V4).encode());
    seeds
}

fn strata_board() -> Seeds {
    let mut stream = Vec::new();
    Response { kind_code: 0x43, status: Status::Ok, payload: b"\x8b\x05\x51\x02Radar\0" }.encode(&mut stream);
    Response { kind_code: 0xC1, status: Status::RequestTypeInvalid, payload: &[] }.encode(&mut stream);
    let mut payload = Vec::new();
    pack(&(0..96).map(|i| i * 41).collect::<Vec<_>>(), &mut payload);
    payload.extend(123_456u64.to_le_bytes());
    let mut seeds = Vec::new();
    for (counter, last) in [(0, false), (1, true), (2, true)] {
        let flags = PacketFlags { first: counter != 1, last, timestamp: last, error: false };
        let mut packet = Vec::new();
        Packet { flags, channel: 0, counter, payload: &payload }.encode(&mut packet);
        stream.extend(&packet);
        seeds.push(packet);
    }
    let flags = PacketFlags { first: true, last: true, timestamp: false, error: true };
    Packet { flags, channel: 0, counter: 3, payload: &7u32.to_le_bytes() }.encode(&mut stream);
    let mut damaged = stream.clone();
    damaged[40] ^= 4;
    seeds.extend([stream, damaged]);
    seeds
}

fn usb() -> Seeds {
    use radome_driver::protocol::cmsis_dap::{Answer, Command, Info};
    use radome_driver::protocol::mcu7::{Framing, Packet, PacketFlags};
    let mut stream = Vec::new();
    for counter in 0..4u16 {
        let flags = PacketFlags { first: true, last: true, timestamp: true, error: counter == 3 };
        Packet { flags, channel: 0, counter, payload: &[counter as u8; 300] }.encode_as(Framing::Bulk, &mut stream);
    }
    vec![stream, Command::Info(Info::Vendor).encode(), Answer::Info(b"KitProg3\0").encode(), vec![0x43, 0x81, 0, 0]]
}

fn deepcraft() -> Seeds {
    use radome_driver::protocol::deepcraft::{
        CapabilitiesRequest, ChunkLayout, Command, Custom, Request, StartRequest, StopRequest,
    };
    let layout = ChunkLayout { device: 0, stream: 0, frame_codes: 16 };
    let mut line = Vec::new();
    for number in 0..3u16 {
        layout.encode(u32::from(number), &(0..16).map(|i| 40 * i + number).collect::<Vec<_>>(), &mut line);
    }
    let mut requests = Vec::new();
    for command in [
        Command::Capabilities(CapabilitiesRequest { device: -1, tag: 7 }),
        Command::Start(StartRequest { device: 0 }),
        Command::Stop(StopRequest { device: -1 }),
    ] {
        Request { command: Some(command) }.encode_to(&mut requests);
    }
    let mut seeds = vec![line, requests];
    seeds.extend(Custom::compile(&waveform()).ok().map(|custom| custom.encode()));
    seeds
}

fn ascii_lines() -> Seeds {
    let mut lines = b"\x07I (312) main: radar started\r\n".to_vec();
    ascii::encode(7, &[0, 4095, 17, 1, 2, 3, 4, 5], &mut lines);
    ascii::encode(9, &[1; 8], &mut lines);
    let mut waveform_line = vec![7];
    ascii::encode_waveform(&waveform().request, &mut waveform_line);
    vec![lines, waveform_line, b"\x01Frame 1: [1,2]\nFrame 2: [1, 2, 3]\nFrame 3: [1, 4096]\nFrame 4: [\n".to_vec()]
}

fn frames() -> Vec<Frame> {
    let waveform = waveform();
    let frame = |sequence: u64| {
        let mut frame = Frame::zeroed(waveform.shape());
        frame.codes = (0..16).map(|i| 4095 - i * 200 - sequence as u16).collect();
        frame.sequence = sequence + 2 * (sequence / 5);
        frame.time_ns = 600_000_000 * sequence;
        frame.truth = sequence.is_multiple_of(2).then_some(Truth { occupancy: Occupancy::One, transition: false });
        frame.temperature_millicelsius = (sequence > 2).then_some(25_000);
        frame
    };
    (0..8).map(frame).collect()
}

fn recording(format: Format) -> tempfile::TempDir {
    let folder = folder();
    let path = folder.path().join("a");
    let header = RecordingHeader::new(waveform());
    let mut writer = RecordingWriter::create(&path, format, &header).expect("creates");
    for frame in frames() {
        writer.frame(&frame).expect("writes");
        if frame.sequence == 4 {
            writer.gap(&Gap { first_sequence: 5, frames: 2, reason: GapReason::Crc }).expect("writes");
        }
    }
    labels().iter().for_each(|label| writer.label(label).expect("writes"));
    writer.finish().expect("finishes");
    folder
}

fn labels() -> Vec<LabelSpan> {
    let mut label = LabelSpan::new(1.5, 2.0, "two, \"quoted\"");
    (label.confidence, label.note) = (Some(0.5), Some("seen".into()));
    vec![LabelSpan::new(0.0, 1.5, "one"), label]
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_default()
}

fn mcap_file() -> Seeds {
    let file = bytes(&recording(Format::Mcap).path().join("a"));
    vec![file[..file.len() - 700].to_vec(), file]
}

fn mcap_content() -> Seeds {
    let waveform = serde_json::to_string(&waveform()).expect("JSON");
    let mut parts: Seeds = vec![b"1".to_vec(), waveform.into_bytes(), b"null".to_vec(), b"[]".to_vec()];
    let mut body = vec![0, 1, 3, 1, 0, 1, 0, 2, 0, 8, 0, 0, 0];
    for sequence in 0..4u64 {
        let mut frame = body.clone();
        frame.extend(sequence.to_le_bytes());
        frame.extend((sequence * 100_000_000).to_le_bytes());
        frame.extend(0u64.to_le_bytes());
        frame.extend(25_000i32.to_le_bytes());
        frame.extend((0..16u16).flat_map(|c| (c * 250).to_le_bytes()));
        parts.push(frame);
        body[0] = 4 * (sequence % 2) as u8;
    }
    parts.push(b"\x01{\"first_sequence\":4,\"frames\":3,\"reason\":\"crc\"}".to_vec());
    parts.push(b"\x06{\"start_s\":0.0,\"end_s\":1.5,\"label\":\"one\",\"who\":\"me\",\"confidence\":0.5}".to_vec());
    vec![parts.join(SEPARATOR)]
}

fn infineon() -> Seeds {
    let folder = recording(Format::Infineon);
    let radar = folder.path().join("a/RadarIfxAvian_00");
    let parts: Seeds = INFINEON_FILES.iter().map(|name| bytes(&radar.join(name))).collect();
    let old_config = r#"{"device_config": {"fmcw_single_shape": {
        "chirp_repetition_time_s": 591.125e-6, "frame_repetition_time_s": 0.1, "if_gain_dB": 23,
        "lower_frequency_Hz": 60.5e9, "upper_frequency_Hz": 61.5e9, "num_chirps_per_frame": 1,
        "num_samples_per_chirp": 8, "rx_antennas": [1, 3], "sample_rate_Hz": 2e6, "tx_power_level": 31}}}"#;
    let mut npy =
        b"\x93NUMPY\x01\x00\x46\x00{'descr': '<u2', 'fortran_order': False, 'shape': (1, 2, 1, 8), }".to_vec();
    npy.resize(79, b' ');
    npy.push(b'\n');
    npy.extend([1; 32]);
    vec![parts.join(SEPARATOR), parts[..2].join(SEPARATOR), [old_config.as_bytes(), &npy].join(SEPARATOR)]
}

fn sdk_text() -> Seeds {
    let folder = recording(Format::Text);
    let parts = ["a_config.json", "a"].map(|name| bytes(&folder.path().join(name)));
    let with_crlf = String::from_utf8_lossy(&parts[1]).replace('\n', "\r\n").into_bytes();
    vec![parts.join(SEPARATOR), [parts[0].clone(), with_crlf].join(SEPARATOR)]
}

fn fixture(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures").join(name);
    std::fs::read_to_string(path).expect("a fixture")
}

/// Input with a scene and its files, in the order of [`radome_fuzz::SCENE_FILES`].
fn scene_seed(scene: &str, others: &[(&str, &str)]) -> Vec<u8> {
    let others: BTreeMap<&str, &str> = others.iter().copied().collect();
    let names = radome_fuzz::SCENE_FILES.iter().skip(1);
    let parts = names.map(|name| others.get(name).copied().unwrap_or_default().as_bytes());
    [scene.as_bytes()].into_iter().chain(parts).collect::<Vec<_>>().join(SEPARATOR)
}

fn scene() -> Seeds {
    let mut seeds = Vec::new();
    for name in ["hall", "corridor", "room", "desk", "bedroom", "bathroom", "room-mesh"] {
        let text = fixture(&format!("scenes/{name}.toml"));
        let receiver_name = text.lines().find_map(|line| line.strip_prefix("receiver = \"../")?.strip_suffix('"'));
        let receiver = fixture(receiver_name.expect("a receiver"));
        let text = text.replace(&format!("../{}", receiver_name.expect("a receiver")), "receiver.toml");
        let text = text.replace("room-mesh.obj", "room.obj");
        let mesh = fixture("scenes/room-mesh.obj");
        let others: &[(&str, &str)] = if name == "room-mesh" {
            &[("receiver.toml", &receiver), ("room.obj", &mesh)]
        } else {
            &[("receiver.toml", &receiver)]
        };
        seeds.push(scene_seed(&text, others));
    }
    let room = fixture("scenes/room-mesh.toml").replace("room-mesh.obj", "room.obj");
    let room = room.replace("receiver = \"../receivers/paper-mesh.toml\"\n", "");
    let mesh = fixture("scenes/room-mesh.obj");
    let (actor, collada, clip) = (biped::gltf(1.0).bytes(), biped::collada(), biped::bvh());
    let actor = String::from_utf8_lossy(&actor).into_owned();
    for (file, text, body) in
        [("actor.gltf", &actor, "mesh"), ("actor.dae", &collada, "mesh"), ("clip.bvh", &clip, "ellipsoids")]
    {
        let people = format!("[people]\nbody = \"{body}\"\n\n[[people.actor]]\nfile = \"{file}\"\n");
        seeds.push(scene_seed(&room.replace("[[people.actor]]\n", &people), &[("room.obj", &mesh), (file, text)]));
    }
    seeds
}

/// Tetrahedron as text and as a binary file.
fn stl() -> Seeds {
    let corners = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let mut text = "solid a thing\n".to_owned();
    let mut binary = vec![b' '; 80];
    binary.extend(4u32.to_le_bytes());
    for triangle in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
        text += "facet normal 0 0 1\n outer loop\n";
        binary.extend([0; 12]);
        for [x, y, z] in triangle.map(|i: usize| corners[i]) {
            text += &format!("  vertex {x} {y} {z}\n");
            binary.extend([x, y, z].into_iter().flat_map(f32::to_le_bytes));
        }
        text += " endloop\nendfacet\n";
        binary.extend([0; 2]);
    }
    text += "endsolid a thing\n";
    vec![text.into_bytes(), binary]
}

fn obj() -> Seeds {
    let small = "mtllib a.mtl\no crate\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl dark wood\n\
                 f 4/1/1 3/1/1 2/1/1 1/1/1\ng other\nf 1//1 2//1 3//1\nf -4 -3 -2\n";
    vec![fixture("scenes/room-mesh.obj").into_bytes(), small.into()]
}

/// glTF files with the buffer inside, beside and after the document.
fn gltf() -> Seeds {
    let person = biped::gltf(1.0);
    let mut with_uri = person.json.clone();
    with_uri["buffers"][0]["uri"] = "buffer.bin".into();
    let with_uri = serde_json::to_vec(&with_uri).expect("JSON");
    let mut document = serde_json::to_vec(&person.json).expect("JSON");
    document.resize(document.len().next_multiple_of(4), b' ');
    let mut binary = b"glTF\x02\0\0\0".to_vec();
    binary.extend((28 + document.len() as u32 + person.buffer.len() as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", &document), (b"BIN\0", &person.buffer)] {
        binary.extend((chunk.len() as u32).to_le_bytes());
        binary.extend(kind);
        binary.extend(chunk);
    }
    vec![person.bytes(), [with_uri, person.buffer].join(SEPARATOR), binary]
}

fn dataset() -> Seeds {
    let folder = folder();
    let path = folder.path().join("set");
    let header = DatasetHeader::new(waveform(), RdmSpec::default()).expect("a header");
    let (range_step_m, velocity_step_m_per_s) = header.rdm_spec.steps(&header.waveform);
    let mut writer = DatasetWriter::create(&path, &header).expect("creates");
    for sequence in 0..4u64 {
        let db = (0..header.shape.cells()).map(|cell| cell as f32 - sequence as f32).collect();
        let flags = MapFlags::default();
        let map = Rdm { shape: header.shape, db, range_step_m, velocity_step_m_per_s, sequence, flags, motion: None };
        let label = Occupancy::from_index(sequence as usize % 3).expect("a class");
        let row = ManifestRow::new(Domain::Sim, "room", "run", &format!("s{}", sequence / 2), sequence, label);
        writer.push(&map, row).expect("writes");
    }
    writer.finish().expect("finishes");
    let names = ["dataset.json", "manifest.jsonl", "maps-00000.npy"];
    vec![names.map(|name| bytes(&path.join(name))).join(SEPARATOR)]
}

/// Card of a network of minimum size.
fn card() -> ModelCard {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/paper-hqnn.safetensors");
    let card = ModelCard::load(&path).expect("a fixture");
    ModelCard { pooled: [1, 1], latent: Default::default(), ..card }
}

fn small_model() -> Model {
    let card = card();
    let network = Network::initialise(&card.network_spec(), 1, 0, KernelLevel::detect()).expect("a network");
    Model { card, network }
}

fn model_file() -> Seeds {
    let folder = folder();
    let path = folder.path().join("a.safetensors");
    small_model().save(&path).expect("writes");
    let card = serde_json::to_string(&card()).expect("JSON");
    vec![bytes(&path), with_card(&card)]
}

fn model_card() -> Seeds {
    let card = serde_json::to_string(&card()).expect("JSON");
    let resnet = card.replace("\"hqnn\"", "\"resnet18\"");
    vec![card.into_bytes(), resnet.into_bytes()]
}

fn onnx_file() -> Seeds {
    vec![radome_models::onnx::export(&small_model()).expect("exports")]
}

fn specs() -> Seeds {
    let training = "seed = 3\nnetwork = \"hqnn\"\nepochs = 4\nbatch_size = 16\npooled = [2, 15]\nlinear_epochs = 2\n\
        [head]\nkind = \"circuit\"\n[head.circuit]\nqubits = 3\ndepth = 2\n[split]\nby = \"seed\"\n[augmentation]\n\
        noise_db = 1.0\n[latent.running]\nmomentum = 0.1\n[smoothing]\ndwell_s = 20\nunseen_share = 0.3\ntemperature = 1.5\n";
    let mut seeds = vec![training.as_bytes().to_vec()];
    for name in ["quick", "paper", "circuits", "controls", "leak", "orientation", "reliability", "strangers"] {
        seeds.push(fixture(&format!("studies/{name}.toml")).into_bytes());
    }
    for name in ["quick", "paper", "halls", "desk", "paper-mesh"] {
        seeds.push(fixture(&format!("datasets/{name}.toml")).into_bytes());
    }
    seeds.push(b"format = 1\n[[recorded]]\nfolders = \"day1\"\nlabels = { \"one_*\" = \"one\" }\nevery = 2\n".to_vec());
    seeds
}

fn main() {
    let root = std::env::args_os().nth(1).expect("usage: seeds FOLDER");
    let targets: [(&str, Seeds); _] = [
        ("usb", usb()),
        ("deepcraft", deepcraft()),
        ("strata_board", strata_board()),
        ("strata_host", strata_host()),
        ("ascii_lines", ascii_lines()),
        ("samples", vec![(0..100).collect(), vec![3, 2, 8, 0, 0xAB, 0xCD, 0xEF]]),
        ("mcap_file", mcap_file()),
        ("mcap_content", mcap_content()),
        ("infineon", infineon()),
        ("sdk_text", sdk_text()),
        ("labels", vec![to_audacity(&labels()).into_bytes(), to_deepcraft(&labels()).into_bytes()]),
        ("scene", scene()),
        ("stl", stl()),
        ("obj", obj()),
        ("gltf", gltf()),
        ("collada", vec![biped::collada().into_bytes()]),
        ("bvh", vec![biped::bvh().into_bytes()]),
        ("dataset", dataset()),
        ("model_file", model_file()),
        ("model_card", model_card()),
        ("onnx_file", onnx_file()),
        ("specs", specs()),
    ];
    for (target, seeds) in targets {
        let folder = Path::new(&root).join(target);
        std::fs::create_dir_all(&folder).expect("a folder");
        for (index, seed) in seeds.iter().enumerate() {
            std::fs::write(folder.join(format!("seed-{index:02}")), seed).expect("writes");
        }
    }
}
