//! Tests of the live page in a browser, and of its defence against hostile clients.

use std::path::{Path, PathBuf};
use std::process::Command;

use radome_tests::browser::{Browser, Served};
use radome_tests::{command, fixture, json_lines, labels_of, live_command, maps_of, simulate, write_file};
use serde_json::{Value, json};

/// Simulates a recording of a corridor in which one person walks between two ranges.
fn simulate_walk(folder: &Path, from_m: f64, to_m: f64, frames: u32) -> PathBuf {
    let scene = radome_tests::write_walking_scene(folder, from_m, to_m);
    let recording = folder.join("walk.mcap");
    simulate(&scene, &format!("--frames {frames}"), &recording);
    recording
}

/// Command that replays a recording.
fn replay_command(recording: &Path, speed: &str) -> Command {
    live_command(recording, &format!("--speed {speed}"))
}

fn replay(recording: &Path, speed: &str) -> Served {
    Served::start(replay_command(recording, speed))
}

/// Speed at which a recording does not end before a key pauses it, however long the browser takes to start.
const SLOW: &str = "0.001";

/// Pauses the playback by its key. The page has to know first that the recording plays: the same key plays one that
/// has ended again.
fn pause_playback(browser: &mut Browser) {
    browser.wait_until("window.radome?.header && radome.labels && radome.playback?.playing");
    browser.key(" ");
    browser.wait_until("!radome.playback.playing");
}

fn read_labels(recording: &Path) -> Vec<(f64, f64, String)> {
    let span = |s: &Value| {
        let time = |name: &str| s[name].as_f64().expect("a time");
        (time("start_s"), time("end_s"), s["label"].as_str().expect("a label").to_owned())
    };
    labels_of(recording).iter().map(span).collect()
}

fn shown_sequence(browser: &mut Browser) -> u64 {
    browser.evaluate("radome.header.answer.sequence").as_u64().expect("a number")
}

#[test]
fn the_map_follows_a_walker_and_velocity_has_the_right_sign() {
    for (from_m, to_m, sign) in [(2.0, 8.0, 1.0), (8.0, 2.0, -1.0)] {
        let folder = tempfile::tempdir().expect("a folder");
        let recording = simulate_walk(folder.path(), from_m, to_m, 50);
        let served = replay(&recording, SLOW);
        let Some(mut browser) = Browser::open(&served.url(), 1280, 900) else { return };
        pause_playback(&mut browser);
        let (mut ranges, mut with, mut pictures) = (Vec::new(), 0, std::collections::BTreeSet::new());
        for at in [10, 20, 30, 40] {
            browser.evaluate(&format!("radome.send({{do: 'seek_frame', sequence: {at}}})"));
            browser.wait_until(&format!("radome.header.answer.sequence === {at}"));
            let echo = browser.evaluate("radome.map.strongest");
            ranges.push(echo["range_m"].as_f64().expect("a range"));
            with += i32::from(echo["velocity_m_per_s"].as_f64().expect("a velocity") * sign > 0.2);
            browser.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))");
            pictures.insert(browser.evaluate("document.getElementById('map').toDataURL()").to_string());
        }
        assert_eq!(pictures.len(), 4, "each frame looks different");
        assert!(with >= 3, "sign {sign}: {with} of 4 frames");
        assert!(sign * (ranges[3] - ranges[0]) > 2.0, "{ranges:?}");
        let said = browser.evaluate("document.getElementById('echo').textContent");
        assert!(said.as_str().expect("text").contains(" m/s "), "{said}");
        assert!(browser.faults.is_empty(), "{:?}", browser.faults);
        drop(browser);
        assert!(served.stop(), "an orderly end");
    }
}

/// The focus of a deleted label goes to the next one, and at last to the title of the list; single characters do nothing when they
/// are switched off.
#[test]
fn labels_are_deleted_one_after_the_other_by_keys_and_single_characters_can_be_switched_off() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 4.0, 40);
    let served = replay(&recording, SLOW);
    let Some(mut browser) = Browser::open(&served.url(), 1280, 1000) else { return };
    pause_playback(&mut browser);
    browser.key("l");
    for start in [0.5, 1.5, 2.5] {
        let request = format!("{{do: 'add', start_s: {start}, end_s: {}, occupancy: 'one'}}", start + 0.5);
        browser.evaluate(&format!("radome.send({request})"));
    }
    browser.wait_until("document.querySelectorAll('#labels-list li').length === 3");
    browser.evaluate("document.querySelectorAll('#labels-list li button:last-of-type')[1].focus()");
    for (left, neighbour_s) in [(2, Some(2.5)), (1, Some(0.5)), (0, None)] {
        browser.evaluate("document.activeElement.closest('li').querySelector('button:last-of-type').click()");
        browser.wait_until(&format!("radome.labels.spans.length === {left}"));
        if let Some(start_s) = neighbour_s {
            browser.wait_until("document.activeElement.textContent === 'go to'");
            let start = "Number(document.activeElement.closest('li').querySelector('input').value)";
            assert_eq!(browser.evaluate(start), json!(start_s), "the neighbour has the focus");
            // A label before it goes, and it keeps the focus.
            let add = "{do: 'add', start_s: 0.1, end_s: 0.2, occupancy: 'two'}";
            browser.evaluate(&format!("radome.send({add})"));
            browser.wait_until(&format!("radome.labels.spans.length === {}", left + 1));
            browser.evaluate("radome.send({do: 'undo'})");
            browser.wait_until(&format!("radome.labels.spans.length === {left}"));
            assert_eq!(browser.evaluate(start), json!(start_s), "it keeps the focus");
        }
    }
    browser.wait_until("document.activeElement.tagName === 'SUMMARY'");
    browser.evaluate("document.getElementById('shortcuts').click()");
    for key in ["1", "r", "ArrowRight"] {
        browser.key(key);
    }
    browser.wait_until("radome.header.answer.sequence > 0");
    assert_eq!(
        browser.evaluate("[radome.labels.open, document.getElementById('chirps-card').open]"),
        json!([null, false])
    );
    browser.evaluate("document.getElementById('shortcuts').click()");
    browser.key("1");
    browser.wait_until("radome.labels.open?.label === 'one'");
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
    drop(browser);
    assert!(served.stop(), "an orderly end");
}

#[test]
fn a_page_too_many_says_so_and_opens_when_another_one_is_closed() {
    let folder = tempfile::tempdir().expect("a folder");
    let served = replay(&simulate_walk(folder.path(), 2.0, 4.0, 20), SLOW);
    let others: Vec<_> = (0..16).map(|_| radome_tests::browser::page(&served.address)).collect();
    let Some(mut browser) = Browser::open(&served.url(), 1280, 1000) else { return };
    browser.wait_until("document.getElementById('status')?.textContent.startsWith('too many pages are open')");
    drop(others);
    browser.wait_until("window.radome?.header && document.getElementById('status').textContent === ''");
    drop(browser);
    assert!(served.stop(), "an orderly end");
}

#[test]
fn a_recording_is_sought_stepped_through_and_labelled_by_keys_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 8.0, 60);
    let before = maps_of(&recording);
    let served = replay(&recording, SLOW);
    let Some(mut browser) = Browser::open(&served.url(), 1280, 1000) else { return };
    pause_playback(&mut browser);

    // Goes to the first frame, ten frames forward and one back; the page shows the requested frame.
    browser.key("Home");
    browser.wait_until("radome.header.answer.sequence === 0");
    // Two jumps of 5 s in a row end at the last frame.
    let jump = "dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight', shiftKey: true }))";
    browser.evaluate(&format!("{jump}, {jump}"));
    browser.wait_until("radome.header.answer.sequence === 59");
    browser.key("Home");
    browser.wait_until("radome.header.answer.sequence === 0");
    for _ in 0..10 {
        browser.key("ArrowRight");
    }
    browser.wait_until("radome.header.answer.sequence === 10");
    browser.key("ArrowLeft");
    browser.wait_until("radome.header.answer.sequence === 9");
    let at_9 = browser.evaluate("Array.from(radome.map.db)");
    browser.key("End");
    browser.wait_until("radome.header.answer.sequence === 59 && radome.header.answer.label");
    browser.evaluate("radome.send({do: 'seek', time_s: 0.85})");
    browser.wait_until("radome.header.answer.sequence === 9");
    assert_eq!(browser.evaluate("Array.from(radome.map.db)"), at_9, "the same frame is the same map");
    // A seek also processes the frames before its target, so that the filter is not in its initial state.
    browser.evaluate("radome.send({do: 'seek_frame', sequence: 50})");
    browser.wait_until("radome.header.answer.sequence === 50");
    let sure = browser.evaluate("Math.max(...Object.values(radome.header.answer.probabilities))");
    assert!(sure.as_f64().expect("a probability") > 0.8, "{sure}");

    // Labels "one" from frame 10, "two" from frame 20, and no label from frame 30.
    browser.evaluate("radome.send({do: 'seek_frame', sequence: 10})");
    browser.wait_until("radome.header.answer.sequence === 10");
    browser.key("1");
    browser.wait_until("radome.labels.open?.label === 'one'");
    for (key, open) in [("2", "radome.labels.open?.label === 'two'"), ("e", "!radome.labels.open")] {
        let from = shown_sequence(&mut browser);
        for _ in 0..10 {
            browser.key("ArrowRight");
        }
        browser.wait_until(&format!("radome.header.answer.sequence === {}", from + 10));
        browser.key(key);
        browser.wait_until(open);
    }
    browser.wait_until("radome.labels.saved && radome.labels.spans.length === 2");
    let near = |a: f64, b: f64| (a - b).abs() < 1e-6;
    let kept = read_labels(&recording);
    assert!(near(kept[0].0, 1.0) && near(kept[0].1, 2.0) && kept[0].2 == "one", "{kept:?}");
    assert!(near(kept[1].0, 2.0) && near(kept[1].1, 3.0) && kept[1].2 == "two", "{kept:?}");

    // Drags the edge of a label to another frame, then undoes it.
    let place = |browser: &mut Browser, time_s: f64| {
        let at = browser.evaluate(&format!(
            "(() => {{ const g = radome.timeline.geometry(), b = radome.timeline.canvas.getBoundingClientRect(); \
             return [b.left + g.x({time_s}), b.top + g.rows.labels[0] + g.rows.labels[1] / 2]; }})()"
        ));
        (at[0].as_f64().expect("x"), at[1].as_f64().expect("y"))
    };
    browser.evaluate("document.getElementById('timeline').scrollIntoView()");
    let (from, to) = (place(&mut browser, 3.0), place(&mut browser, 4.0));
    browser.drag((from.0 - 1.0, from.1), to);
    browser.wait_until("radome.labels.saved && Math.abs(radome.labels.spans[1].end_s - 4) < 1e-6");
    assert!(near(read_labels(&recording)[1].1, 4.0));
    browser.key("u");
    browser.wait_until("radome.labels.saved && Math.abs(radome.labels.spans[1].end_s - 3) < 1e-6");
    assert!(near(read_labels(&recording)[1].1, 3.0));

    // Tests exports, and a label that is still open at the end of the run.
    let text = browser.evaluate("fetch('labels.txt').then(r => r.text())");
    assert_eq!(text.as_str().expect("text").lines().count(), 2, "{text}");
    browser.key("0");
    browser.wait_until("radome.labels.open?.label === 'empty'");
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
    drop(browser);
    assert!(served.stop());
    let kept = read_labels(&recording);
    assert!(kept.len() == 3 && kept[2].2 == "empty" && near(kept[2].0, 3.0) && near(kept[2].1, 3.1), "{kept:?}");
    assert!(maps_of(&recording) == before, "labels leave frames alone");
}

#[test]
fn the_page_fits_a_phone_asks_for_nothing_from_elsewhere_and_shows_what_it_is_told_to() {
    let folder = tempfile::tempdir().expect("a folder");
    let served = replay(&simulate_walk(folder.path(), 2.0, 8.0, 30), "1");
    let Some(mut browser) = Browser::open(&served.url(), 390, 844) else { return };
    browser.wait_until("window.radome?.header && radome.hello");
    let width = browser.evaluate("document.documentElement.scrollWidth").as_f64().expect("a width");
    assert!(width <= 390.0, "{width}");
    // Readings and controls filled the first screen, and the timeline was beyond it.
    let [timeline, keys] = [("timeline", "bottom"), ("keys", "top")].map(|(id, edge)| {
        browser.evaluate(&format!("document.getElementById('{id}').getBoundingClientRect().{edge}")).as_f64()
    });
    assert!(timeline <= keys, "{timeline:?} {keys:?}");
    let from = browser.evaluate("performance.getEntriesByType('resource').map(e => e.name)");
    let from = from.as_array().expect("a list");
    assert!(from.len() >= 11 && from.iter().all(|u| u.as_str().expect("text").starts_with(&served.url())), "{from:?}");
    // Every control has a name.
    let nameless = browser.evaluate(
        "[...document.querySelectorAll('button, select, input, canvas, summary')].filter(e => !(e.labels?.length || \
         e.getAttribute('aria-label') || e.textContent.trim())).map(e => e.id)",
    );
    assert_eq!(nameless, json!([]));
    // The keys change channel, static removal and raw chirps, and the answer follows each request.
    for (key, holds) in [
        ("c", "radome.header.look.channel.rx === 0"),
        ("s", "radome.header.look.removal === 'mti'"),
        ("s", "radome.header.look.removal === 'none'"),
        ("h", "radome.map.held"),
        ("r", "radome.header.chirps?.samples === radome.hello.samples"),
    ] {
        browser.key(key);
        browser.wait_until(holds);
    }
    let same = "radome.map.held.every((v, i) => v >= radome.map.db[i])";
    assert_eq!(browser.evaluate(same), json!(true));
    // The Tab key reaches all controls.
    let mut seen = std::collections::BTreeSet::new();
    for _ in 0..60 {
        browser.key("Tab");
        seen.insert(browser.evaluate("document.activeElement.id || document.activeElement.textContent").to_string());
    }
    for id in ["channel", "removal", "hold", "map", "play", "seek", "at", "undo", "help-open"] {
        // Tab skips disabled controls.
        let usable = browser.evaluate(&format!("!document.getElementById('{id}').disabled")) == json!(true);
        assert!(!usable || seen.contains(&format!("\"{id}\"")), "{id} in {seen:?}");
    }
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
}

#[test]
fn a_simulated_partner_stands_beside_its_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = simulate_walk(folder.path(), 2.0, 6.0, 30);
    let pair = folder.path().join("walk-pair");
    let corridor = fixture("scenes/corridor.toml");
    json_lines(command!("scene pair --json --people 1 --corrections 0 -o", &pair, &recording, corridor));
    let served = replay(&recording, "1");
    let Some(mut browser) = Browser::open(&served.url(), 1280, 1200) else { return };
    browser.wait_until("window.radome?.hello?.partner && radome.header?.partner");
    browser.evaluate("radome.send({do: 'pause'})");
    browser.evaluate("radome.send({do: 'seek_frame', sequence: 20})");
    browser.wait_until("radome.header.answer.sequence === 20 && radome.header.partner");
    let [real, simulated] =
        ["map", "partner"].map(|view| browser.evaluate(&format!("radome.{view}.strongest.range_m")));
    let apart = real.as_f64().expect("a range") - simulated.as_f64().expect("a range");
    assert!(apart.abs() < 1.0, "{real} and {simulated}");
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
}

#[test]
fn an_old_answer_is_not_shown_as_the_present_one() {
    let served = Served::start(live_command(fixture("scenes/corridor.toml"), "--speed 1 --frames 100000"));
    let Some(mut browser) = Browser::open(&served.url(), 1280, 900) else { return };
    let is_blank = "document.getElementById('answer').value === '–' && document.getElementById('occupied').hidden && \
                    !document.getElementById('confidence').textContent && document.body.classList.contains('stale')";
    let says = |text: &str| format!("document.getElementById('status')?.textContent.startsWith('{text}')");
    browser.wait_until("window.radome?.header");
    browser.wait_until("['empty', 'one', 'two'].includes(document.getElementById('answer').value)");
    // The connection stays open, but no messages arrive.
    served.program.signal("STOP");
    browser.wait_until(&format!("{is_blank} && {}", says("no frames for")));
    served.program.signal("CONT");
    let has_frame = "document.getElementById('frame').textContent.startsWith('frame ')";
    browser.wait_until(&format!("!({is_blank}) && !document.body.classList.contains('stale') && {has_frame}"));
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
    assert!(served.stop(), "an orderly end");
    browser.wait_until(&format!("{is_blank} && {}", says("the run is over")));
    // A label that nobody receives is not lost without a word.
    browser.key("1");
    browser.wait_until("document.getElementById('notice').textContent.startsWith('No connection')");
}

/// Tabs of several rooms were all called radome.
#[test]
fn the_title_tells_rooms_apart_and_holds_the_present_answer() {
    for (options, room) in [("", "corridor"), ("--mqtt mqtt://127.0.0.1:1 --mqtt-name Bedroom", "Bedroom")] {
        let options = format!("--speed 1 --frames 100000 {options}");
        let served = Served::start(live_command(fixture("scenes/corridor.toml"), &options));
        let Some(mut browser) = Browser::open(&served.url(), 1280, 900) else { return };
        browser.wait_until(&format!("/^(empty|one|two) · .*{room}.* · radome$/.test(document.title)"));
        served.program.signal("STOP");
        browser.wait_until("document.title.startsWith('– · ')");
        served.program.signal("CONT");
    }
}

/// Makes the pictures of the README and of `docs/page.md`.
#[test]
#[ignore = "makes files: RADOME_PICTURES=docs cargo test --release --workspace --test page -- --ignored pictures"]
fn pictures() {
    let Some(to) = std::env::var_os("RADOME_PICTURES").map(|to| radome_tests::root().join(to)) else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("evening.mcap");
    simulate(&fixture("scenes/corridor.toml"), "--frames 300 --seed 100001", &recording);
    let served = replay(&recording, "3");
    let Some(mut browser) = Browser::open(&served.url(), 1280, 1060) else { return };
    browser.wait_until("window.radome?.header && radome.labels");
    let shot = |browser: &mut Browser, name: &str| {
        browser.evaluate("new Promise(r => setTimeout(r, 600))");
        browser.screenshot(&to.join(name));
    };
    let label = |browser: &mut Browser, start_s: f64, end_s: f64, occupancy: &str| {
        browser.evaluate(&format!(
            "radome.send({{do: 'add', start_s: {start_s}, end_s: {end_s}, occupancy: '{occupancy}', who: 'A. Reader'}})"
        ));
    };
    browser.wait_until("radome.header.answer.sequence > 275");
    browser.evaluate("radome.send({do: 'pause'})");
    browser.evaluate("radome.send({do: 'seek_frame', sequence: 269})");
    browser.wait_until("radome.header.answer.sequence === 269");
    for (start_s, end_s, occupancy) in [(0.0, 2.3, "empty"), (2.3, 3.5, "one"), (3.5, 14.1, "two"), (14.1, 15.2, "one")]
    {
        label(&mut browser, start_s, end_s, occupancy);
    }
    browser.wait_until("radome.labels.spans.length === 4 && radome.labels.saved");
    shot(&mut browser, "live-page.png");

    browser.call(
        "Emulation.setEmulatedMedia",
        json!({ "features": [{ "name": "prefers-color-scheme", "value": "dark" }] }),
    );
    browser.resize(390, 844, 2.0);
    shot(&mut browser, "live-page-phone.png");

    browser.call("Emulation.setEmulatedMedia", json!({ "features": [] }));
    browser.resize(1280, 1120, 1.0);
    browser
        .evaluate("document.getElementById('chirps-card').open = document.getElementById('labels-card').open = true");
    browser.wait_until("radome.header.chirps");
    browser.evaluate("document.getElementById('time-card').scrollIntoView()");
    shot(&mut browser, "live-page-labels.png");
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
}

mod hard_cases;

/// Resident memory of a process and of all its descendants, bytes.
fn memory_bytes(id: u32) -> f64 {
    let mut parents = std::collections::BTreeMap::new();
    for entry in std::fs::read_dir("/proc").expect("a list").flatten() {
        let Some(process) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else { continue };
        let Ok(status) = std::fs::read_to_string(entry.path().join("status")) else { continue };
        let field = |name: &str| -> f64 {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            line.and_then(|l| l.split_whitespace().next()).and_then(|n| n.parse().ok()).unwrap_or(0.0)
        };
        // Counts anonymous pages only: pages that map files are shared between processes.
        parents.insert(process, (field("PPid:") as u32, 1024.0 * field("RssAnon:")));
    }
    let is_of = |mut process: u32| {
        while process != id && process > 1 {
            process = parents.get(&process).map_or(0, |p| p.0);
        }
        process == id
    };
    parents.iter().filter(|(process, _)| is_of(**process)).map(|(_, (_, bytes))| bytes).sum()
}

/// Checks memory of a page that stays open at ten times real time for `RADOME_PAGE_S` seconds (`tests/long page`).
#[test]
#[ignore = "takes half an hour: tests/long page"]
#[allow(clippy::print_stderr)]
fn hours_of_frames_need_constant_memory() {
    let length_s: f64 = std::env::var("RADOME_PAGE_S").ok().and_then(|s| s.parse().ok()).unwrap_or(1800.0);
    // The desk scene has twenty frames a second and is simulated fast enough.
    let frames = (200.0 * (length_s + 120.0)) as u64;
    let (scene, model) = (fixture("scenes/desk-person.toml"), fixture("models/desk-hqnn.safetensors"));
    let demo = command!("demo --json --speed 10 --frames", frames.to_string(), "--scene", scene, "--model", model);
    let served = Served::start(demo);
    let Some(mut browser) = Browser::open(&served.url(), 1280, 1100) else { return };
    browser.wait_until("window.radome?.header");
    browser.key("r");
    browser.key("h");
    // Waits until all buffers of fixed size are full. The server's history fills within a minute at this pace; the page
    // allocates its own at the start.
    let settle_s = (0.2 * length_s).clamp(20.0, 400.0);
    let begun = std::time::Instant::now();
    let mut heard = Vec::new();
    let mut next_s = settle_s;
    while begun.elapsed().as_secs_f64() < length_s {
        std::thread::sleep(std::time::Duration::from_secs(1));
        if begun.elapsed().as_secs_f64() >= next_s {
            let (heap, server) = (browser.heap_bytes(), memory_bytes(served.program.id()));
            let (whole, pictures) = (memory_bytes(browser.id()), browser.evaluate("radome.pictures"));
            eprintln!(
                "{next_s:6.0} s: server {:.1} MB, browser {:.1} MB of which objects {:.2} MB, {pictures} pictures, frame {}, lost {}",
                server * 1e-6,
                whole * 1e-6,
                heap * 1e-6,
                browser.evaluate("radome.header.answer.sequence"),
                browser.evaluate("radome.header.health.dropped"),
            );
            heard.push((server, whole, heap));
            next_s += (length_s - settle_s) / 10.0;
        }
    }
    assert!(browser.faults.is_empty(), "{:?}", browser.faults);
    // Compares medians of the first and last three readings, since a single reading depends on the latest request.
    let median = |of: &[(f64, f64, f64)], which: fn(&(f64, f64, f64)) -> f64| {
        let mut values: Vec<f64> = of.iter().map(which).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    for (name, which) in
        [("server", (|m| m.0) as fn(&(f64, f64, f64)) -> f64), ("browser", |m| m.1), ("the page's objects", |m| m.2)]
    {
        let (first, last) = (median(&heard[..3], which), median(&heard[heard.len() - 3..], which));
        eprintln!(
            "{name}: {:.1} MB, then {:.1} MB ({:+.1} %)",
            first * 1e-6,
            last * 1e-6,
            100.0 * (last / first - 1.0)
        );
        assert!(last < 1.1 * first, "{name} grew from {first} to {last} bytes");
    }
}
