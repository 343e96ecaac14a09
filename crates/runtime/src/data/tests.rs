use super::*;
use proptest::prelude::*;
use std::io::{self, Cursor, Read};

fn log(text: &str, options: &Options) -> Result<Log, DataError> {
    Log::from_csv(Cursor::new(text.as_bytes().to_vec()), "log.csv".as_ref(), options)
}

fn entries(text: &str, options: &Options) -> (Vec<Entry>, Counts) {
    let mut log = log(text, options).unwrap();
    let entries: Vec<Entry> = log.by_ref().map(Result::unwrap).collect();
    (entries, *log.counts())
}

/// Returns the first error, on opening or in a row.
fn refusal(text: &str, options: &Options) -> String {
    match log(text, options) {
        Err(error) => error.to_string(),
        Ok(log) => log.filter_map(Result::err).next().expect("it is refused").to_string(),
    }
}

#[test]
fn units_delimiters_quotes_comments_and_line_ends_are_read() {
    let (entries, counts) = entries(
        "\u{feff}# a logger wrote this\r\n\"time (ms)\"; gyro_x[deg/s] ;gyro_y[deg/s];gyro_z[deg/s];note\r\n\
         1000;180; -90 ;\"0\";\"a;b\"\r\n\r\n# pause\r\n1010.5;0;0;3.6e2;\r\n",
        &Options::default(),
    );
    let pi = std::f64::consts::PI;
    assert_eq!(entries.len(), 2);
    assert_eq!((entries[0].row, entries[0].time_s, entries[0].rate_rad_s), (3, 0.0, [pi, -pi / 2.0, 0.0]));
    assert_eq!((entries[1].row, entries[1].rate_rad_s), (6, [0.0, 0.0, 2.0 * pi]));
    assert!((entries[1].time_s - 0.0105).abs() < 1e-15);
    assert_eq!((counts.rows, counts.used, counts.segments), (2, 2, 1));
}

#[test]
fn segments_begin_at_a_new_key_a_gap_and_a_step_back() {
    let mut text = String::from("t_s,wx,wy,wz,throw\n");
    for (time, key) in [
        (0.0, "a"),
        (0.1, "a"),
        (0.1, "a"),
        (0.2, "a"),
        (0.3, "b"),
        (0.4, "b"),
        (0.95, "b"),
        (1.05, "b"),
        (0.5, "b"),
        (0.6, "b"),
    ] {
        text += &format!("{time},1,2,3,{key}\n");
    }
    let by = Options { by: Some("throw".to_owned()), ..Options::default() };
    let (entries, counts) = entries(&text, &by);
    assert_eq!(entries.iter().map(|entry| entry.segment).collect::<Vec<_>>(), [0, 0, 0, 1, 1, 2, 2, 3, 3]);
    assert_eq!((counts.repeated, counts.gaps, counts.backward, counts.segments), (1, 1, 1, 4));
    assert!((counts.interval_s[1] - 0.1).abs() < 1e-12, "{counts:?}");
    let mut patient = log(&text, &Options { gap_s: Some(1.0), ..by }).unwrap();
    patient.by_ref().for_each(drop);
    assert_eq!((patient.counts().gaps, patient.segment_name().as_str()), (0, "b"));
}

#[test]
fn a_log_without_header_is_read_by_numbers() {
    let options = Options {
        time: Some("1".to_owned()),
        rates: Some(["4", "3", "-"].map(str::to_owned)),
        unnamed: true,
        may_lack: [false, false, true],
        ..Options::default()
    };
    let (entries, counts) = entries("0,9,2,1\n0.01,9,,1\n0.02,9,NaN,1\n0.03,9,2,1\n", &options);
    assert_eq!(entries.iter().map(|entry| entry.row).collect::<Vec<_>>(), [1, 4]);
    assert_eq!(entries[0].rate_rad_s[..2], [1.0, 2.0]);
    assert!(entries[0].rate_rad_s[2].is_nan());
    assert_eq!(counts.incomplete, 2);
}

#[test]
fn nanoseconds_since_1970_keep_their_differences() {
    let (entries, _) =
        entries("stamp_ns,wx,wy,wz\n1763800000000000000,0,0,0\n1763800000000000100,0,0,0\n", &Options::default());
    assert_eq!(entries[1].time_s, 1e-7);
}

#[test]
fn an_invalid_log_is_refused_with_place_reason_and_remedy() {
    let none = Options::default();
    for (text, words) in [
        ("", "it has no row of numbers"),
        ("t_s,wx,wy,wz\n", "it has no row of numbers"),
        ("t_s,wx,wy,wz\n0,0,1,5,2,0,3,0\n", "log.csv:2: the row has 8 cells in place of 4"),
        ("t_s,wx,wy,wz\n0,1,2,3\n0.1,1,2\n", "log.csv:3: the row has 3 cells"),
        ("t_s,wx,wy,wz\n0,1,2,3\n\n0.1,1,two,3\n", "log.csv:4: column wy: `two` is not a number"),
        ("t_s,wx,wy,wz\n0,inf,2,3\n", "`inf` is not finite"),
        ("t_s,wx,wy,wz\n0,1e999,2,3\n", "`1e999` is not finite"),
        ("t_s,wx,wy,wz\n1e300,1,2,3\n", "out of the range of time stamps"),
        ("t_s,wx,wy,wz\n12:30:01,1,2,3\n12:30,1,2,3\n", "column t_s: `12:30` is not a time of day"),
        ("t,wx,wy,wz\n0,1,2,3\n10020000,1,2,3\n20040000,1,2,3\n", "give --time-unit ns"),
        ("SampleTimeFine,Gyr_X,Gyr_Y,Gyr_Z\n0,500,2,3\n10000,500,2,3\n20000,500,2,3\n", "give --time-unit us"),
        ("SampleTimeFine,Gyr_X,Gyr_Y,Gyr_Z\n0,9,6,8\n100,9,6,8\n200,9,6,8\n", "--time SampleTimeFine --rate-hz 10000"),
        ("SampleTimeFine,Gyr_X,Gyr_Y,Gyr_Z\n0,.1,0,0\n16667,.1,0,0\n33333,.1,0,0\n", "give --time-unit us"),
        ("t,wx,wy,wz\n0,9,6,8\n100,9,6,8\n200,9,6,8\n", "the rate of a counter with --rate-hz"),
        ("t_ms;wx;wy;wz\n12,345;1.5;2.5;3\n12,355;1.5;2.5;3\n", "`12,345` has a comma, and others a decimal point"),
        ("t_ms;wx;wy;wz\n0;999;2;3\n10;1,001;2;3\n", "commas group the digits"),
        ("\0\0", "the file is not text"),
        ("0,1,2,3\n1,1,2,3\n", "if it has no header say so"),
    ] {
        let refused = refusal(text, &none);
        assert!(refused.contains(words), "{text:?}: {refused}");
    }
    let gap = Options { gap_s: Some(-1.0), ..Options::default() };
    assert!(refusal("t_s,wx,wy,wz\n0,1,2,3\n", &gap).contains("give a number above 0"));
    let missing = Log::open("no/such/file".as_ref(), &none).err().unwrap().to_string();
    assert!(missing.contains("cannot read no/such/file"), "{missing}");
}

#[test]
fn stamps_must_order_the_rows() {
    let text = |stamp: fn(u32) -> u32| {
        (0..30).fold("t_ms,wx,wy,wz\n".to_owned(), |text, row| text + &format!("{},{row},2,3\n", stamp(row)))
    };
    let none = Options::default();
    for (stamp, words) in [
        ((|row| 900 - 10 * row) as fn(u32) -> u32, "29 of the first 29 rows have an earlier stamp"),
        (|row| 10 * (row ^ 1), "have an earlier stamp"),
        (|_| 7, "the stamps are too coarse"),
        (|row| row / 10, "the stamps are too coarse"),
    ] {
        let refused = refusal(&text(stamp), &none);
        assert!(refused.contains(words), "{refused}");
    }
    // Two rows of each stamp, and a second run.
    assert_eq!(entries(&text(|row| 10 * (row / 2)), &none).1.repeated, 15);
    assert_eq!(entries(&text(|row| 10 * (row % 15)), &none).1.segments, 2);
}

#[test]
fn utf_16_is_read_with_or_without_a_byte_order_mark() {
    let text = "t (µs);gyro_x (°/s);gyro_y (°/s);gyro_z (°/s)\r\n0;180;0;0\r\n1000;90;0;0\r\n";
    let little: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let big: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
    for bytes in [little.clone(), big, [vec![0xff, 0xfe], little].concat()] {
        let mut log = Log::from_csv(Cursor::new(bytes), "log.csv".as_ref(), &Options::default()).unwrap();
        let entry = log.nth(1).unwrap().unwrap();
        assert_eq!((entry.time_s, entry.rate_rad_s[0]), (1e-3, std::f64::consts::FRAC_PI_2));
        assert!(log.meaning().found.contains("UTF-16"), "{:?}", log.meaning());
    }
}

#[test]
fn a_line_without_end_is_not_held_in_memory() {
    let endless = Cursor::new(b"t_s,wx,wy,wz\n".to_vec()).chain(io::repeat(b'1').take(1 << 40));
    let mut log = match Log::from_csv(endless, "log.csv".as_ref(), &Options::default()) {
        Err(error) => return assert!(error.to_string().contains("longer than 1 MiB"), "{error}"),
        Ok(log) => log,
    };
    assert!(log.next().unwrap().is_err());
}

proptest! {
    #[test]
    fn random_bytes_do_not_panic_and_rows_are_sane(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let mut text = b"t_s,wx,wy,wz\n".to_vec();
        text.extend(bytes);
        check(text);
    }

    #[test]
    fn random_cells_do_not_panic_and_rows_are_sane(rows in proptest::collection::vec(
        proptest::collection::vec("-?[0-9]{0,4}(\\.[0-9]{0,3})?(e[+-]?[0-9]{1,3})?|nan|inf|,|\"|;", 3..6), 0..30)
    ) {
        let lines: Vec<String> = rows.iter().map(|cells| cells.join(",")).collect();
        check(format!("t_s,wx,wy,wz\n{}\n", lines.join("\n")).into_bytes());
    }
}

fn check(bytes: Vec<u8>) {
    let Ok(mut log) = Log::from_csv(Cursor::new(bytes), "log.csv".as_ref(), &Options::default()) else { return };
    let mut last: Option<Entry> = None;
    let mut used = 0;
    for entry in log.by_ref() {
        let Ok(entry) = entry else { break };
        assert!(entry.time_s.is_finite() && entry.rate_rad_s.iter().all(|rate| rate.is_finite()));
        assert_eq!(entry.begins, last.is_none_or(|last| last.segment != entry.segment));
        assert!(entry.begins || last.is_some_and(|last| entry.time_s > last.time_s));
        (last, used) = (Some(entry), used + 1);
    }
    let counts = log.counts();
    assert_eq!(counts.used, used);
    assert_eq!(counts.rows, counts.used + counts.incomplete + counts.repeated + counts.outside);
}
