//! Logs as other programs write them: read at the first try, or refused with their unit or the motion named.

use crate::common::Bench;
use corotate::model::{Inertia, Noise, RigidBody};
use nalgebra::Vector3;
use serde_json::Value;
use std::fmt::Write;

const MOMENTS: [f64; 3] = [0.4, 0.8, 1.0];
/// A header with units.
const KNOWN: &str = "t_s,wx_rad_s,wy_rad_s,wz_rad_s\n";

/// Returns time and rates of a free motion, s and rad/s, at 100 Hz.
fn motion(samples: u32) -> Vec<[f64; 4]> {
    let body = RigidBody::new(&Inertia::new(MOMENTS).unwrap());
    let mut rate = Vector3::new(8.0, 1.0, 6.0);
    let sample = |tick| {
        let row = [f64::from(tick) * 0.01, rate.x, rate.y, rate.z];
        rate = body.flow(&rate, &Vector3::zeros(), 0.01);
        row
    };
    (0..samples).map(sample).collect()
}

/// Returns a table of the motion: each row by `row`, each rate in a unit of `rad_s` rad/s.
fn table(head: &str, rad_s: f64, row: impl Fn(f64, [String; 3]) -> String) -> String {
    let rows = motion(80)
        .into_iter()
        .map(|[time_s, x, y, z]| row(time_s, [x, y, z].map(|rate| format!("{:.5}", rate / rad_s))));
    rows.fold(head.to_owned(), |text, row| text + &row + "\n")
}

fn plain(head: &str, rad_s: f64) -> String {
    table(head, rad_s, |time_s, [x, y, z]| format!("{time_s:.2},{x},{y},{z}"))
}

fn in_deg(head: &str) -> String {
    plain(head, std::f64::consts::PI / 180.0)
}

/// Writes a table of the given rows.
fn rows(head: &str, rows: impl IntoIterator<Item = [f64; 4]>) -> String {
    rows.into_iter().fold(head.to_owned(), |text, [t, x, y, z]| text + &format!("{t:.6},{x:.9},{y:.9},{z:.9}\n"))
}

/// Asserts that the body was found.
fn assert_body(found: &Value, tolerance: f64, about: &str) {
    for (moment, expected) in found["body"]["inertia_kg_m2"].as_array().unwrap().iter().zip(MOMENTS) {
        assert!((moment.as_f64().unwrap() - expected).abs() < tolerance, "{about}: {found:#}");
    }
}

/// Returns a text in Latin-1.
fn latin1(text: &str) -> Vec<u8> {
    text.chars().map(|letter| u8::try_from(u32::from(letter)).unwrap()).collect()
}

#[test]
fn tables_of_many_forms_give_the_body_at_the_first_try() {
    let bench = Bench::new();
    let semicolons = |head: &str| table(head, 1.0, |t, rates| format!("{t:.2};{}", rates.join(";")).replace('.', ","));
    let clock = |t: f64| format!("12:00:{t:06.3}");
    let last_cut = {
        let mut text = plain("t,wx,wy,wz\n", 1.0);
        text.truncate(text.len() - 12);
        text
    };
    let forms: Vec<(&str, Vec<u8>)> = vec![
        ("decimal-comma.csv", semicolons("t;wx;wy;wz\n").into()),
        ("preamble.csv", plain("Device: phone\nRate, 100, Version, 2\n\nt (s),wx (rad/s),wy (rad/s),wz (rad/s)\n", 1.0).into()),
        ("comments.csv", plain("% made by\n// a logger\nt,wx,wy,wz\n", 1.0).into()),
        ("in-comment.csv", plain("#timestamp [s],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]\n", 1.0).into()),
        ("two-lines.csv", semicolons("Time (s);IMU Gyroscope;;\n;X;Y;Z\n").into()),
        ("units-below.csv", in_deg("time,gyro_x,gyro_y,gyro_z\ns,deg/s,deg/s,deg/s\n").into()),
        ("spaces.txt", table(" time  wx wy   wz\n", 1.0, |t, rates| format!("  {t:.2}   {}", rates.join("  "))).into()),
        ("pipes.txt", table("time|wx|wy|wz\n", 1.0, |t, rates| format!("{t:.2} | {}", rates.join(" | "))).into()),
        ("no-line-end.csv", last_cut.into()),
        ("zeros.csv", [plain("t,wx,wy,wz\n", 1.0).into_bytes(), vec![0; 3000]].concat()),
        ("clock.csv", table("time,wx,wy,wz\n", 1.0, |t, rates| format!("{},{}", clock(t), rates.join(","))).into()),
        ("iso.csv", table("Date,wx,wy,wz\n", 1.0, |t, r| format!("2026-11-28T{}Z,{}", clock(t), r.join(","))).replace("Date", "datetime").into()),
        ("micro.csv", latin1(&table("time (µs);gx;gy;gz\n", 1.0, |t, rates| format!("{:.0};{}", t * 1e6, rates.join(";"))))),
        ("degree-latin1.csv", latin1(&in_deg("t_s,Gyro X (°/s),Gyro Y (°/s),Gyro Z (°/s)\n"))),
        ("degree-mac.csv", latin1(&in_deg("t_s,Gyro X (¡/s),Gyro Y (¡/s),Gyro Z (¡/s)\n"))),
        ("degree-ring.csv", in_deg("t_s,Gyro X (˚/s),Gyro Y (˚/s),Gyro Z (˚/s)\n").into()),
        ("degree-ordinal.csv", in_deg("t_s,Gyro X (º/s),Gyro Y (º/s),Gyro Z (º/s)\n").into()),
        ("rpm.csv", plain("t_s,gyro_x (rpm),gyro_y (rpm),gyro_z (rpm)\n", std::f64::consts::TAU / 60.0).into()),
        ("mdps.csv", plain("t_s,gyro_x_mdps,gyro_y_mdps,gyro_z_mdps\n", std::f64::consts::PI / 180e3).into()),
        ("one-based.csv", plain("time,gyro_1,gyro_2,gyro_3\n", 1.0).into()),
        ("phyphox.csv", plain("\"Time (s)\",\"X (rad/s)\",\"Y (rad/s)\",\"Z (rad/s)\"\n", 1.0).into()),
        ("Gyroscope.csv", table("time,seconds_elapsed,z,y,x\n", 1.0, |t, [x, y, z]| {
            format!("{:.0},{t:.3},{z},{y},{x}", 1.7e18 + t * 1e9)
        }).into()),
        ("betaflight.csv", in_deg("time (s),gyroADC[0] (deg/s),gyroADC[1] (deg/s),gyroADC[2] (deg/s)\n").into()),
        ("bag.csv", table("%time,field.header.stamp,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z\n", 1.0,
            |t, rates| format!("{:.0},{:.0},{}", 1.7e18 + t * 1e9, 1.7e18 + t * 1e9, rates.join(","))).into()),
        ("plotjuggler.csv", plain("__time,/imu/angular_velocity/x,/imu/angular_velocity/y,/imu/angular_velocity/z\n", 1.0).into()),
        ("stamps.csv", table("header.stamp.sec,header.stamp.nanosec,angular_velocity.x,angular_velocity.y,angular_velocity.z\n", 1.0,
            |t, rates| format!("1700000000,{:.0},{}", t * 1e9, rates.join(","))).into()),
        ("sensorlog.csv", plain("motionTimestamp_sinceReboot(s),motionRotationRateX(rad/s),motionRotationRateY(rad/s),motionRotationRateZ(rad/s)\n", 1.0).into()),
        ("ardupilot.csv", table("TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ\n", 1.0, |t, rates| format!("{:.0},{},0,0,9.8", t * 1e6, rates.join(","))).into()),
        (
            "epoch.csv",
            table("time,wx,wy,wz\n", 1.0, |t, rates| format!("{:.0},{}", 1.7e12 + t * 1e3, rates.join(","))).into(),
        ),
        ("euler.csv", in_deg("seconds_elapsed,roll_rate_dps,pitch_rate_dps,yaw_rate_dps\n").into()),
        ("capitals.CSV", plain("TIME,WX,WY,WZ\n", 1.0).into()),
        ("other-header.csv", plain("t;wx;wy;wz\n", 1.0).into()),
        ("subscripts.txt", table("# Rate: 415 Hz\n#time      ωₓ (rad/s)      ωᵧ (rad/s)      ωᶻ (rad/s)\n", 1.0, |t, rates| {
            format!("{t:.2}      {}", rates.join("      "))
        }).into()),
        ("micro-rates.csv", plain("t_s,P (µrad/s),Q (µrad/s),R (µrad/s)\n", 1e-6).into()),
        ("minutes.csv", table("Zeit,Drehrate x,Drehrate y,Drehrate z\n", 1.0, |t, r| format!("59:{t:05.2},{}", r.join(","))).into()),
        ("milliseconds.csv", table("time,wx,wy,wz\n", 1.0, |t, rates| format!("{:.1},{}", 1.7e12 + t * 1e3, rates.join(","))).into()),
    ];
    for (name, bytes) in forms {
        std::fs::write(bench.path(name), bytes).unwrap();
        let done = bench.run(&["identify", name, "--json"]);
        assert_eq!(done.code, Some(0), "{name}: {}", done.stderr);
        assert_body(&done.json(), 0.01, name);
    }
    // The options for what is not found out.
    let counted =
        table("PacketCounter,IMU A,IMU B,IMU C\n", 1.0, |t, rates| format!("{:.0},{}", t * 100.0, rates.join(",")));
    let counter = ["--skip", "2", "--time", "1", "--rates", "imu a,IMU B,4", "--rate-hz", "100"];
    for (text, code, options) in [
        (plain("\"Time, s\",\"IMU, X\",\"IMU, Y\",\"IMU, Z\"\n", 1.0), "no-such-column", &["--rates", "2,3,4"][..]),
        (format!("1,2,3,4\n1,2,3,4\n{counted}"), "no-such-column", &counter),
        (plain("t_s,gyro_x (lsb),gyro_y (lsb),gyro_z (lsb)\n", 1e-3), "unknown-unit", &["--rate-scale", "0.001"]),
    ] {
        std::fs::write(bench.path("log.csv"), text).unwrap();
        assert!(bench.run(&["identify", "log.csv"]).says(code));
        let found = bench.run(&[&["identify", "log.csv", "--json"], options].concat()).succeeded().json();
        assert_body(&found, 0.01, code);
    }
}

#[test]
fn the_end_of_a_damaged_table_is_left_out_and_counted() {
    let bench = Bench::new();
    let text = plain("t,wx,wy,wz\n", 1.0);
    std::fs::write(bench.path("half.csv"), format!("{text}0.80,1.2")).unwrap();
    std::fs::write(bench.path("zeros.csv"), format!("{text}0.80,1.2\0\0\0\0\n1,2,3,4\n")).unwrap();
    for (name, zeros) in [("half.csv", 0), ("zeros.csv", 1)] {
        let found = bench.run(&["identify", name, "--json"]).succeeded().json();
        let counts = &found["logs"][0]["counts"];
        let seen = [&counts["rows"], &counts["half_written"], &counts["zero_tail"]];
        assert_eq!(seen, [80, 1, zeros].map(serde_json::Value::from).each_ref(), "{name}: {counts}");
    }
    // Within the table it is a mistake.
    std::fs::write(bench.path("short.csv"), text.replacen("0.40,", "", 1)).unwrap();
    let refused = bench.run(&["identify", "short.csv"]);
    assert!(refused.code == Some(2) && refused.says("row-length"), "{refused:?}");
}

#[test]
fn units_that_are_impossible_or_not_known_are_refused_by_name() {
    let bench = Bench::new();
    let rpm = std::f64::consts::TAU / 60.0;
    let millis = |head: &str| table(head, 1.0, |t, rates| format!("{:.0},{}", t * 1e3, rates.join(",")));
    // A slow body turns by little between samples in wrong units too; only its motion shows them.
    let slow = |rad_s: f64, per_second: f64| {
        let slowed =
            |[t, x, y, z]: [f64; 4]| [t * 50.0 * per_second, 0.02 * x / rad_s, 0.02 * y / rad_s, 0.02 * z / rad_s];
        rows("t,wx,wy,wz\n", motion(400).into_iter().map(slowed))
    };
    let deg = std::f64::consts::PI / 180.0;
    let hidden = ["--hidden", "z", "--inertia", ".4,.8,1"];
    for (name, text, parts) in [
        ("deg.csv", in_deg("t,wx,wy,wz\n"), &["deg/s", "implausible-unit"][..]),
        ("ms.csv", millis("time,wx,wy,wz\n"), &["--time-unit ms", "implausible-unit"]),
        ("mrad.csv", plain("t,xgyro,ygyro,zgyro\n", 1e-3), &["implausible-unit"]),
        ("slow-deg.csv", slow(deg, 1.0), &["--rate-unit deg/s", "implausible-unit"]),
        ("slow-rpm.csv", slow(rpm, 1.0), &["--rate-unit rpm", "implausible-unit"]),
        ("slow-ms.csv", slow(1.0, 1e3), &["implausible-unit"]),
        ("slow-half.csv", slow(0.5, 1.0), &["5.000e-1 times", "implausible-unit"]),
        ("minutes-as-s.csv", slow(1.0, 1.0 / 60.0), &["6.000e1 times", "implausible-unit"]),
        (
            "lost.csv",
            in_deg("t_s,Gyro X (\u{fffd}/s),Gyro Y (\u{fffd}/s),Gyro Z (\u{fffd}/s)\n"),
            &["\u{fffd}/s", "unknown-unit"],
        ),
        ("absent.csv", in_deg("t_s,Gyro X (/s),Gyro Y (/s),Gyro Z (/s)\n"), &["`/s`", "unknown-unit"]),
        ("gon.csv", in_deg("t_s,Gyro X (gon/s),Gyro Y (gon/s),Gyro Z (gon/s)\n"), &["gon/s", "unknown-unit"]),
        ("minutes.csv", plain("Time (min),wx,wy,wz\n", 1.0), &["min", "unknown-unit"]),
    ] {
        std::fs::write(bench.path(name), text).unwrap();
        for command in [&["identify", name][..], &[&["estimate", name], &hidden[..]].concat()] {
            let refused = bench.run(command);
            let code = if parts.contains(&"unknown-unit") { 2 } else { 1 };
            assert_eq!(refused.code, Some(code), "{command:?}: {refused:?}");
            assert!(refused.stdout.is_empty(), "{command:?}: {refused:?}");
            assert!(parts.iter().all(|part| refused.stderr.contains(part)), "{command:?}: {}", refused.stderr);
        }
    }
    // With two rates, the third one follows from the body.
    for (name, part) in [("slow-deg.csv", "--rate-unit deg/s"), ("slow-rpm.csv", "--rate-unit rpm")] {
        let refused = bench.run(&[&["estimate", name, "--rates", "wx,wy,-"], &hidden[..]].concat());
        assert!(refused.code == Some(1) && refused.says("implausible-unit"), "{name}: {refused:?}");
        assert!(refused.stderr.contains(part), "{name}: {}", refused.stderr);
    }
    // However the columns were chosen.
    let named = ["--rates", "Gyro X (gon/s),Gyro Y (gon/s),Gyro Z (gon/s)"];
    let refused = bench.run(&[&["identify", "gon.csv"], &named[..]].concat());
    assert!(refused.code == Some(2) && refused.says("unknown-unit"), "{refused:?}");
    let given = [&["identify", "deg.csv"][..], &["--rate-unit", "deg/s", "--time-unit", "s"]].concat();
    bench.run(&given).succeeded();
    let leader = bench.run(&["init", "recorded-leader"]).succeeded().stdout.replace("tumbling-throw.csv", "deg.csv");
    std::fs::write(bench.path("own.toml"), leader).unwrap();
    let refused = bench.run(&["check", "own.toml"]);
    assert!(refused.code == Some(2) && refused.says("implausible-unit"), "{refused:?}");
    std::fs::write(bench.path("deg.csv"), plain("t,wx,wy,wz\n", 1.0)).unwrap();
    let assumed = bench.run(&["check", "own.toml"]);
    assert!(assumed.stdout.contains("wx, wy, wz in rad/s, as assumed"), "{assumed:?}");
}

#[test]
fn a_motion_that_is_not_free_gives_no_body_in_a_short_log_too() {
    let bench = Bench::new();
    let wave = |t: f64| [t, 0.0, 0.0, 5.0 * (2.0 * t).sin()];
    for (name, motion) in [
        ("swing.csv", wave as fn(f64) -> [f64; 4]),
        ("constant.csv", |t| [t, 1.0, 2.0, 3.0]),
        ("slowing.csv", |t| [t, 5.0 * (-t).exp(), 3.0 * (-t).exp(), 4.0 * (-t).exp()]),
    ] {
        let text = rows(KNOWN, (0..300).map(|tick| motion(f64::from(tick) * 0.01)));
        std::fs::write(bench.path(name), text).unwrap();
        let refused = bench.run(&["identify", name]);
        assert!(refused.code == Some(1) && refused.says("one-axis"), "{name}: {refused:?}");
        assert!(!refused.stdout.contains("inertia_kg_m2"), "{name}: {refused:?}");
    }
    for (name, samples, step_s) in [("short.csv", 60, 0.05), ("long.csv", 3000, 0.01), ("fast.csv", 100, 0.02)] {
        let driven = |tick| {
            let t = f64::from(tick) * step_s;
            [t, 1.0 + (3.0 * t).sin(), (2.3 * t).sin() + 0.2 * (5.1 * t).cos(), 4.0 + (1.7 * t).cos()]
        };
        std::fs::write(bench.path(name), rows(KNOWN, (0..samples).map(driven))).unwrap();
        for method in ["axes", "tensor", "recursive"] {
            let refused = bench.run(&["identify", name, "--method", method]);
            assert!(refused.code == Some(1) && refused.says("not-free"), "{name} {method}: {refused:?}");
            assert!(!refused.stdout.contains("inertia_kg_m2"), "{name} {method}: {refused:?}");
            let json = bench.run(&["identify", name, "--method", method, "--json"]);
            assert!(json.json()["body"].is_null(), "{name} {method}: {json:?}");
        }
    }
}

/// Returns five throws at 100 Hz of a sensor with noise beside the body's centre, which lies still before each and is stopped after it.
fn thrown(accelerometer: bool) -> String {
    let (body, moments) = (RigidBody::new(&Inertia::new(MOMENTS).unwrap()), Vector3::from(MOMENTS));
    let (place, mut noise) = (Vector3::new(0.02, -0.01, 0.01), Noise::new(5, 0, [0.5; 3], [0.0; 3]));
    let mut text = KNOWN.trim_end().to_owned() + if accelerometer { ",ax,ay,az\n" } else { "\n" };
    let mut rows = 0;
    for throw in 0..5 {
        let (mut rate, mut angle) = (Vector3::new(8.0, 1.0 + f64::from(throw), 6.0), 0.0);
        for tick in 0..240 {
            let part = f64::from(240 - tick) / 60.0;
            let held = Vector3::new(f64::sin(angle), 0.0, f64::cos(angle)) * 9.81;
            let (shown, force) = match tick {
                0..100 => (Vector3::zeros(), held),
                100..180 => {
                    rate = body.flow(&rate, &Vector3::zeros(), 0.01);
                    let change = -rate.cross(&moments.component_mul(&rate)).component_div(&moments);
                    (rate, change.cross(&place) + rate.cross(&rate.cross(&place)))
                }
                _ => (rate * part, held),
            };
            angle += shown.norm() * 0.01;
            let shown = shown + noise.sample();
            write!(text, "{:.2},{:.4},{:.4},{:.4}", f64::from(rows) * 0.01, shown.x, shown.y, shown.z).unwrap();
            if accelerometer {
                write!(text, ",{:.3},{:.3},{:.3}", force.x, force.y, force.z).unwrap();
            }
            text.push('\n');
            rows += 1;
        }
    }
    text
}

#[test]
fn an_accelerometer_shows_the_free_motion_that_noise_hides() {
    let bench = Bench::new();
    for accelerometer in [false, true] {
        std::fs::write(bench.path("thrown.csv"), thrown(accelerometer)).unwrap();
        let done = bench.run(&["identify", "thrown.csv", "--find-free", "--method", "tensor", "--json"]);
        if !accelerometer {
            assert!(done.code == Some(1) && done.says("not-free"), "{done:?}");
            continue;
        }
        let found = done.succeeded().json();
        let parts = found["logs"][0]["parts_s"].as_array().unwrap();
        assert_eq!(parts.len(), 5, "{parts:?}");
        assert_eq!(found["logs"][0]["accelerometer"], serde_json::json!(["ax", "ay", "az"]));
        let estimate = ["estimate", "thrown.csv", "--find-free", "--hidden", "z", "--inertia", "0.4,0.8,1"];
        for command in [&["identify", "thrown.csv", "--find-free", "--method", "tensor"][..], &estimate] {
            let shown = bench.run(command).succeeded().stdout;
            assert!(shown.contains("free motion shown by `ax`, `ay`, `az`\n"), "{shown}");
        }
        for (part, throw) in parts.iter().zip(0..) {
            let ends = [0, 1].map(|end| part[end].as_f64().unwrap() - 2.4 * f64::from(throw));
            assert!((ends[0] - 1.0).abs() < 0.1 && (ends[1] - 1.8).abs() < 0.1, "{parts:?}");
        }
        assert_body(&found, 0.05, "thrown");
    }
}

#[test]
fn a_wheel_is_part_of_the_model_and_gives_the_moments_their_scale() {
    let bench = Bench::new();
    let text = include_str!("../data/gyrostat.csv");
    std::fs::write(bench.path("log.csv"), text).unwrap();
    // The same body with its sensor turned about z, by cosine 0.8 and sine 0.6.
    let turned = text.lines().enumerate().map(|(line, text)| {
        let cells: Vec<f64> = text.split(',').filter_map(|cell| cell.parse().ok()).collect();
        match (line, &cells[..]) {
            (0, _) => text.to_owned(),
            (_, [t, x, y, z]) => format!("{t},{:.6},{:.6},{z}", 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x),
            _ => panic!("{text}"),
        }
    });
    std::fs::write(bench.path("turned.csv"), turned.collect::<Vec<_>>().join("\n")).unwrap();
    for (log, wheel, method) in [
        ("log.csv", "0.004,-0.006,0.012", "axes"),
        ("log.csv", "0.004,-0.006,0.012", "tensor"),
        ("turned.csv", "-0.0004,-0.0072,0.012", "tensor"),
    ] {
        let found = bench.run(&["identify", log, "--wheel", wheel, "--method", method, "--json"]).succeeded();
        std::fs::write(bench.path("body.json"), &found.stdout).unwrap();
        let mut moments: Vec<f64> = serde_json::from_value(found.json()["body"]["inertia_kg_m2"].clone()).unwrap();
        moments.sort_by(f64::total_cmp);
        for (moment, expected) in moments.iter().zip([0.030, 0.042, 0.050]) {
            assert!((moment / expected - 1.0).abs() < 2e-3, "{log} {method}: {found:?}");
        }
        assert!(found.json()["recursive"].is_null(), "{found:?}");
        for axis in ["x", "y", "z"] {
            let estimated =
                bench.run(&["estimate", log, "--hidden", axis, "--body", "body.json", "--json"]).succeeded();
            let part = estimated.json()["score"]["part"]["median"].as_f64().unwrap();
            assert!(part < 0.01, "{log} {axis}: {part}");
        }
    }
    for (wheel, code) in [
        // Without the wheel it is the motion of no body, and with the opposite one too.
        (&[][..], "not-free"),
        (&["--wheel", "-0.004,0.006,-0.012"][..], "no-such-wheel"),
    ] {
        let refused = bench.run(&[&["identify", "log.csv"], wheel].concat());
        assert!(refused.code == Some(1) && refused.says(code), "{wheel:?}: {refused:?}");
        assert!(!refused.stdout.contains("inertia_kg_m2"), "{refused:?}");
    }
    let refused = bench.run(&["identify", "log.csv", "--wheel", "0,0,1", "--method", "recursive"]);
    assert!(refused.code == Some(2) && refused.says("wheel-not-modelled"), "{refused:?}");
    let alike = ["--inertia", "0.03,0.05,0.05", "--wheel", "0,0.01,0"];
    let refused = bench.run(&[&["estimate", "log.csv", "--hidden", "z"], &alike[..]].concat());
    assert!(refused.code == Some(2) && refused.says("impossible-estimate"), "{refused:?}");
}

#[test]
fn an_estimate_tells_why_it_is_useless() {
    let bench = Bench::new();
    std::fs::write(bench.path("good.csv"), plain(KNOWN, 1.0)).unwrap();
    // Every 40th sample of a motion of 10 rad/s.
    std::fs::write(bench.path("coarse.csv"), rows(KNOWN, motion(4000).into_iter().step_by(40))).unwrap();
    let estimate = |log: &str, more: &[&str]| bench.run(&[&["estimate", log, "--hidden", "x"], more].concat());
    let diverged = estimate("good.csv", &["--inertia", "0.4,0.8,1", "--damping=-60"]);
    assert!(diverged.code == Some(1) && diverged.says("diverged"), "{diverged:?}");
    assert!(diverged.stdout.lines().all(|line| line.len() < 200), "{diverged:?}");
    let long = estimate("coarse.csv", &["--inertia", "0.4,0.8,1"]);
    assert!(long.code == Some(1) && long.says("steps-too-long"), "{long:?}");
    let blind = estimate("good.csv", &["--inertia", "0.4,0.8,1", "--floor", "100"]);
    assert!(blind.code == Some(1) && blind.says("never-observed"), "{blind:?}");
    let misfit = estimate("good.csv", &["--inertia", "1,0.8,0.4"]);
    assert!(misfit.stdout.contains("the body does not fit this motion"), "{misfit:?}");
    let fits = estimate("good.csv", &["--inertia", "0.4,0.8,1"]).succeeded();
    assert!(!fits.stdout.contains("does not fit") && !fits.stdout.contains("ambiguous"), "{fits:?}");
}

#[test]
fn a_log_is_cut_by_times_by_a_file_and_by_its_free_motion() {
    let bench = Bench::new();
    let body = RigidBody::new(&Inertia::new(MOMENTS).unwrap());
    // Throws at different rates, with hand motions of two seconds between them.
    let (mut samples, mut parts) = (Vec::new(), String::new());
    let mut push = |rate: Vector3<f64>| {
        let time_s = samples.len() as f64 * 0.01;
        samples.push([time_s, rate.x, rate.y, rate.z]);
        time_s
    };
    for throw in 0..12_u32 {
        let phase = f64::from(throw) * 1.7;
        for tick in 0..200 {
            let t = phase + f64::from(tick) * 0.01;
            push(Vector3::new(
                (7.0 * t).sin() * 5.0,
                (4.3 * t + phase).cos() * 4.0,
                (5.9 * t).sin() * 6.0 + (2.0 * t).cos(),
            ));
        }
        let mut rate = Vector3::new(8.0 * phase.sin(), 3.0 + phase.cos(), 6.0 * (1.3 * phase).cos());
        let begin_s = push(rate);
        let end_s = (0..79).fold(begin_s, |_, _| {
            rate = body.flow(&rate, &Vector3::zeros(), 0.01);
            push(rate)
        });
        writeln!(parts, "{begin_s:.2},{end_s:.2}").unwrap();
    }
    std::fs::write(bench.path("uncut.csv"), rows(KNOWN, samples.iter().copied())).unwrap();
    std::fs::write(bench.path("hand.csv"), rows(KNOWN, samples.into_iter().take(200))).unwrap();
    std::fs::write(bench.path("parts.csv"), format!("begin,end\n{parts}")).unwrap();
    let numbered: String = parts.lines().zip(0..).map(|(part, number)| format!("{number},{part},,free\n")).collect();
    std::fs::write(bench.path("numbered.csv"), "segment,start,end,keep,comment\n".to_owned() + &numbered).unwrap();
    let whole = bench.run(&["identify", "uncut.csv"]);
    assert!(whole.code == Some(1) && whole.says("not-free"), "{whole:?}");
    let first: Vec<&str> = parts.lines().next().unwrap().split(',').collect();
    for (options, segments) in [
        (&["--from", first[0], "--to", first[1]][..], 1),
        (&["--segments", "parts.csv"], 12),
        (&["--segments", "numbered.csv"], 12),
        (&["--find-free"], 12),
    ] {
        let found = bench.run(&[&["identify", "uncut.csv", "--json"], options].concat()).succeeded().json();
        let log = &found["logs"][0];
        assert!(log["accelerometer"].is_null());
        let found_parts = log["parts_s"].as_array().unwrap().len() as u64;
        assert_eq!((&log["counts"]["segments"], found_parts), (&segments.into(), segments));
        assert_body(&found, 0.01, options[0]);
        let used_s = log["counts"]["used_s"].as_f64().unwrap();
        assert!((used_s / (0.79 * segments as f64) - 1.0).abs() < 0.25, "{options:?}: {used_s}");
        bench
            .run(&[&["estimate", "uncut.csv", "--hidden", "z", "--inertia", "0.4,0.8,1"], options].concat())
            .succeeded();
    }
    std::fs::write(bench.path("bad.csv"), "1,2\n3,2\n").unwrap();
    std::fs::write(bench.path("names.csv"), "a,b,c\n1,2,3\n").unwrap();
    for (options, code) in [
        (&["--segments", "bad.csv"][..], "not-a-log"),
        (&["--segments", "names.csv"], "not-a-log"),
        (&["--segments", "absent.csv"], "cannot-read"),
        (&["--from", "1000"], "no-rows-used"),
    ] {
        let refused = bench.run(&[&["identify", "uncut.csv"], options].concat());
        assert!(code == "no-rows-used" && refused.code == Some(1) || refused.says(code), "{options:?}: {refused:?}");
    }
    let refused = bench.run(&["identify", "hand.csv", "--find-free"]);
    assert!(refused.code == Some(1) && refused.says("not-free"), "{refused:?}");
}
