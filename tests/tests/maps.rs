//! Compares `radome recording maps` on the real recording with an independent f64 implementation of the formula.

use std::f64::consts::TAU;

use radome_tests::{command, fails_with, fixture, json_lines, shared, wrong_use_with};

#[test]
fn maps_of_the_real_recording_are_right_to_a_hundredth_of_a_decibel() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let output = folder.path().join("maps.npy");
    let said = json_lines(command!("recording maps --json", &recording, "-o", &output));
    assert_eq!(said[0]["shape"], serde_json::json!([256, 3, 8, 32]));

    let read = |path: &std::path::Path| std::io::BufReader::new(std::fs::File::open(path).expect("readable"));
    let maps: Vec<f32> = npyz::NpyFile::new(read(&output)).expect("npy").into_vec().expect("f32");
    let codes: Vec<u16> =
        npyz::NpyFile::new(read(&recording.join("RadarIfxAvian_00/radar.npy"))).expect("npy").into_vec().expect("u16");

    let (m, n) = (8usize, 64usize);
    let hann =
        |length: usize| (0..length).map(|i| 0.5 - 0.5 * (TAU * i as f64 / length as f64).cos()).collect::<Vec<_>>();
    let (doppler_window, range_window) = (hann(m), hann(n));
    let norm = doppler_window.iter().sum::<f64>() * range_window.iter().sum::<f64>();
    let mut worst = 0.0f64;
    for map in 0..256 * 3 {
        let chirp = |c: usize| &codes[(map * m + c) * n..(map * m + c + 1) * n];
        for k in 0..n / 2 {
            let profile: Vec<(f64, f64)> = (0..m)
                .map(|c| {
                    chirp(c).iter().enumerate().fold((0.0, 0.0), |(re, im), (s, code)| {
                        let x = (f64::from(*code) - 2048.0) / 2048.0 * range_window[s] * doppler_window[c];
                        let (sin, cos) = (TAU * ((k * s) % n) as f64 / n as f64).sin_cos();
                        (re + x * cos, im - x * sin)
                    })
                })
                .collect();
            for i in 0..m {
                let l = (i + m / 2) % m;
                let (re, im) = profile.iter().enumerate().fold((0.0, 0.0), |(re, im), (c, (a, b))| {
                    let (sin, cos) = (TAU * ((l * c) % m) as f64 / m as f64).sin_cos();
                    (re + a * cos + b * sin, im + b * cos - a * sin)
                });
                let amplitude = if k == 0 { 1.0 } else { 2.0 } * f64::hypot(re, im) / norm;
                let want = (20.0 * amplitude.log10()).max(-200.0);
                let got = f64::from(maps[(map * m + i) * (n / 2) + k]);
                if want > -100.0 {
                    worst = worst.max((got - want).abs());
                }
            }
        }
    }
    assert!(worst < 0.01, "{worst} dB");
}

/// Asserts that `-o -` writes the bytes of the file to stdout and messages to stderr.
#[test]
fn an_array_on_stdout_is_the_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let (input, path) = (fixture("formats/recording.mcap"), folder.path().join("maps.npy"));
    json_lines(command!("recording maps --json -o", &path, &input));
    let output = command!("recording maps -o -", &input).output().expect("runs");
    assert!(output.status.success() && String::from_utf8_lossy(&output.stderr).contains("8 maps"));
    assert!(output.stdout == std::fs::read(&path).expect("reads"));
    let array = npyz::NpyFile::new(output.stdout.as_slice()).expect("npy");
    assert_eq!(array.shape(), [8, 2, 2, 4]);
    let picture = folder.path().join("map.png");
    for wrong in [["--frame", "100"], ["--across-frames", "1000"], ["--frames", "0"]] {
        fails_with(command!("recording maps", ..wrong, &input, "--png", &picture), &["map", "frames", "hint"]);
        assert!(!picture.exists(), "{wrong:?}");
    }
    // Messages had the program's own index in place of the number that was given.
    for rx in ["0", "4"] {
        let part = format!("--rx {rx}: frames have 2 receive channels");
        wrong_use_with(command!("recording maps --rx", rx, &input, "--png", &picture), &[&part]);
    }
    for frames in ["0", "1"] {
        let command = command!("recording maps --across-frames", frames, &input, "--png", &picture);
        wrong_use_with(command, &["a map needs at least 2 frames"]);
    }
    // An array is no picture, and a picture no array.
    wrong_use_with(command!("recording maps", &input, "-o", &picture), &["map.png", "--png writes a picture"]);
    wrong_use_with(
        command!("recording maps --overwrite", &input, "--png", &path),
        &["maps.npy", "-o writes the array"],
    );
    assert!(!picture.exists());
    wrong_use_with(command!("recording maps --json -o -", &input), &["--json", "stdout"]);
}
