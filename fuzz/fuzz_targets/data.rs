//! Any bytes as a log, alone and after a valid header: the log is refused with a reason, or read in order, identified
//! and estimated with finite results wherever they must be finite.
#![no_main]

use corotate::data::{Log, Options};
use corotate::estimate::{FilterKind, RateSurvey, Reconstruction, Setup};
use corotate::identify::{Motion, RecursiveIdentifier, Sample, findings};
use corotate::model::Inertia;
use libfuzzer_sys::fuzz_target;
use std::io::Cursor;

/// One of this many inputs is fitted: a fit takes a thousand times as long as reading.
const FITTED: usize = 16;

fn read(bytes: Vec<u8>, options: &Options) {
    let is_fitted = bytes.len() % FITTED == 0;
    let mut log = match Log::from_csv(Cursor::new(bytes), "fuzz.csv".as_ref(), options) {
        Ok(log) => log,
        Err(error) => return assert!(!error.to_string().is_empty()),
    };
    let coefficients = Inertia::new([1.0, 2.0, 2.5]).expect("a body").coefficients();
    let (mut motion, mut recursive, mut survey) =
        (Motion::default(), RecursiveIdentifier::new(None, 0.1), RateSurvey::new(&coefficients, 3));
    let filter = FilterKind::First { decay_per_s: 5.0 };
    let setup =
        Setup { coefficients, axis: 3, damping_per_s: 0.1, wheel: None, filter, guess_rad_s: None, floor_rad_s: 1e-3 };
    let mut reconstruction = Reconstruction::new(&setup).expect("the axis is observable");
    let mut last_s = f64::NEG_INFINITY;
    for entry in log.by_ref() {
        let Ok(entry) = entry else { break };
        assert!(entry.time_s.is_finite() && entry.rate_rad_s.iter().all(|rate| rate.is_finite()));
        assert!(entry.begins || entry.time_s > last_s);
        last_s = entry.time_s;
        let sample = Sample { time_s: entry.time_s, rate_rad_s: entry.rate_rad_s.into() };
        if entry.begins {
            motion.end_segment();
            recursive.end_segment();
            survey.end_segment();
            reconstruction.end_segment();
        }
        motion.push(&sample);
        recursive.push(&sample);
        survey.push(&sample);
        let _ = reconstruction.push(&sample);
    }
    motion.end_segment();
    let _ = (recursive.fit(), survey.choose());
    if is_fitted {
        let (axes, tensor) = (motion.about_known_axes(true), motion.about_unknown_axes(true));
        let body = motion.moments_about_known_axes(false);
        assert!(!findings(&motion, axes.as_ref(), body.as_ref(), tensor.as_ref()).is_empty());
    }
    let counts = log.counts();
    assert_eq!(counts.rows, counts.used + counts.incomplete + counts.repeated + counts.outside);
}

fuzz_target!(|bytes: &[u8]| {
    read(bytes.to_vec(), &Options::default());
    let by = Options { by: Some("throw".to_owned()), ..Options::default() };
    read([b"throw,t_s,wx,wy,wz\n", bytes].concat(), &by);
});
