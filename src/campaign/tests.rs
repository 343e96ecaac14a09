//! What a campaign's text and a case's number make.

use super::axis::Varied;
use super::file::{Raw, SEED_BITS};
use super::*;
use crate::config::{self, Checks, ConfigError, Document};
use proptest::prelude::*;
use std::borrow::Cow;
use std::collections::BTreeSet;
use toml::Value;

fn shipped(name: &str) -> Result<Cow<'static, str>, ConfigError> {
    let found = config::SHIPPED.iter().find(|(known, _)| *known == name);
    found.map(|(_, text)| Cow::Borrowed(*text)).ok_or_else(|| {
        let text = format!("there is no `{name}`; take another");
        ConfigError::Unknown { code: "unknown-scenario", text }
    })
}

fn campaign(text: &str) -> Campaign {
    Campaign::parse(text, "map.toml", &[], &shipped).unwrap_or_else(|error| panic!("{error}"))
}

fn refused(text: &str) -> String {
    let text =
        if text.contains("base") { text.to_owned() } else { format!("name = \"map\"\nbase = \"rigid-pair\"\n{text}") };
    Campaign::parse(&text, "map.toml", &[], &shipped).err().map_or("valid".to_owned(), |error| error.to_string())
}

const COMBINED: &str = "
    name = \"map\"
    base = \"rigid-pair\"
    repeats = 2
    [[axis]]
    key = \"controller.gain_per_s\"
    values = [1.0, 2.0, 4.0]
    [[axis]]
    key = \"observer.decay_rate_per_s\"
    range = { from = 2.0, to = 8.0, points = 3, log = true }
    [[axis]]
    key = \"leader.initial_rate_rad_s.0\"
    random = { uniform = [-1.0, 1.0] }
    [[margin]]
    find = \"smallest\"
    key = \"observer.decay_rate_per_s\"
    from = 0.5
    to = 50.0
    tolerance = 0.5
";

#[test]
fn all_combinations_come_in_their_order_each_with_its_own_seed() {
    let campaign = campaign(COMBINED);
    assert_eq!(campaign.cases(), 18);
    let cases: Vec<Case> = (0..18).map(|number| campaign.case(number).unwrap()).collect();
    let numbers = |case: &Case, axis: usize| case.parameters[axis].number().unwrap();
    let expected = (0..18).map(|n| ([1.0, 2.0, 4.0][n / 6], [2.0, 4.0, 8.0][n / 2 % 3]));
    for (case, (gain, decay)) in cases.iter().zip(expected) {
        assert_eq!(numbers(case, 0), gain);
        assert!((numbers(case, 1) - decay).abs() < 1e-12);
    }
    let seeds: BTreeSet<u64> = cases.iter().map(|case| case.seed).collect();
    let drawn: BTreeSet<u64> = cases.iter().map(|case| numbers(case, 2).to_bits()).collect();
    assert_eq!((seeds.len(), drawn.len()), (18, 18));
    assert!(campaign.case(18).is_none());
    let scenario = campaign.scenario(&cases[17]).unwrap();
    assert_eq!(scenario.seed, cases[17].seed);
    assert_eq!(scenario.resolved["controller"]["gain_per_s"].as_array().unwrap(), &vec![Value::Float(4.0); 3]);
    let rate = scenario.resolved["leader"]["initial_rate_rad_s"].as_array().unwrap();
    assert_eq!(rate[0].as_float(), cases[17].parameters[2].number());
}

/// Published cases stay valid. The numbers come from another program.
#[test]
fn a_case_is_the_same_for_ever() {
    let case = campaign(COMBINED).case(11).unwrap();
    assert_eq!(
        (case.seed, case.parameters[2].clone()),
        (7_887_410_569_048_683, Parameter::Number(0.014_944_523_804_348_63))
    );
}

#[test]
fn a_margin_has_a_point_for_every_case_without_its_axis() {
    let campaign = campaign(COMBINED);
    let searched = &campaign.margins()[0];
    assert_eq!(campaign.points(searched), 6);
    for point in 0..6 {
        let case = campaign.case_at(searched, point).unwrap();
        assert_eq!(case.parameters[1].number(), Some(2.0), "the first value of the axis");
        assert_eq!(campaign.point(searched, case.number), Some(point));
    }
    assert_eq!(campaign.point(searched, 2), None, "the second value");
    assert_eq!(searched.parameters(&campaign.case(0).unwrap())[1], None);
}

#[test]
fn the_campaign_as_resolved_is_the_same_campaign() {
    for (name, text) in SHIPPED.into_iter().chain([("map", COMBINED)]) {
        let campaign = campaign(text);
        let nothing = |name: &str| Err(ConfigError::Unknown { code: "unknown-scenario", text: name.to_owned() });
        let again = Campaign::parse(campaign.to_toml(), "again.toml", &[], &nothing).unwrap();
        assert_eq!((again.identity(), again.cases()), (campaign.identity(), campaign.cases()), "{name}");
        for number in 0..campaign.cases().min(40) {
            let case = campaign.case(number).unwrap();
            assert_eq!(case, again.case(number).unwrap(), "{name}");
            let text = |campaign: &Campaign| campaign.scenario(&case).unwrap().to_toml();
            assert_eq!(text(&campaign), text(&again), "{name}");
        }
    }
}

#[test]
fn an_override_is_of_every_case_and_another_campaign() {
    let changed = Campaign::parse(COMBINED, "map.toml", &["tick_hz=500.0".to_owned()], &shipped).unwrap();
    assert_eq!(changed.scenario(&changed.case(3).unwrap()).unwrap().period_ns, 2_000_000);
    assert_ne!(changed.identity(), campaign(COMBINED).identity());
}

#[test]
fn a_fault_with_zero_amount_is_removed() {
    let (_, text) = SHIPPED[0];
    let campaign = campaign(text);
    let faults = |number| campaign.scenario(&campaign.case(number).unwrap()).unwrap().faults.clone();
    assert_eq!(faults(0).len(), 0, "no loss");
    assert_eq!(faults(3).len(), 1);
    assert_eq!(faults(8 * 3).len(), 0, "no loss at another delay");
}

#[test]
fn factors_are_of_what_is_there_and_reach_every_number_of_a_table() {
    let (_, text) = SHIPPED.into_iter().find(|(name, _)| *name == "noise-filter").unwrap();
    let campaign = campaign(text);
    let case = campaign.case(7 * 2 * 4 + 7 + 6).unwrap();
    assert_eq!(case.parameters[1], Parameter::Word("second-order".to_owned()));
    let resolved = campaign.scenario(&case).unwrap().resolved;
    assert!((resolved["observer"]["bandwidth_rad_s"].as_float().unwrap() - 16.0).abs() < 1e-12);
    let noise = resolved["leader"]["noise_rad_s"].as_array().unwrap();
    assert!((noise[0].as_float().unwrap() - 2e-2).abs() < 1e-15 && noise[2].as_float() == Some(0.0));
}

#[test]
fn a_base_is_read_beside_its_campaign() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("pair.toml"), config::SHIPPED[0].1).unwrap();
    let path = directory.path().join("map.toml");
    std::fs::write(&path, "name = \"map\"\nbase = \"pair.toml\"\n").unwrap();
    assert_eq!(Campaign::load(&path, &[], &shipped).unwrap().cases(), 1);
    std::fs::write(&path, "name = \"map\"\nbase = \"none.toml\"\n").unwrap();
    let error = Campaign::load(&path, &[], &shipped).unwrap_err().to_string();
    assert!(error.contains("map.toml:2: base: ") && error.contains("none.toml"), "{error}");
}

#[test]
fn errors_name_the_place_and_the_remedy() {
    let axis = |text: &str| refused(&format!("[[axis]]\nkey = \"tick_hz\"\n{text}"));
    for (found, expected) in [
        (refused("colour = 1"), "map.toml:3: colour: unknown key"),
        (refused("[[axis]]\nkeys = 1"), "map.toml:4: axis[0].keys: unknown key; did you mean `key`?"),
        (axis(""), "map.toml:3: axis[0]: "),
        (axis("values = []"), "map.toml:5: axis[0].values: "),
        (axis("values = [1]\nnames = [\"a\", \"b\"]"), "axis[0].names: has 2 names for 1 values"),
        (axis("range = { from = 2.0, to = 1.0, points = 3 }"), "axis[0].range: 2 is not below 1"),
        (axis("range = { from = 0.0, to = 1.0, points = 3, log = true }"), "axis[0].range: starts at 0"),
        (axis("range = { from = 1.0, to = 2.0 }"), "axis[0].range.points: is missing"),
        (axis("range = { from = 1, to = 4, points = 3 }"), "map.toml:5: axis[0].range"),
        (axis("range = { from = \"a\", to = 4, points = 3 }"), "axis[0].range: "),
        (axis("random = { normal = [1.0, 0.0] }"), "axis[0].random.normal: 0 "),
        (axis("random = {}"), "axis[0].random: "),
        (axis("values = [\"a\"]\nfactor = true"), "axis[0].factor: "),
        (refused("samples = 0"), "samples: 0 "),
        (refused("sampling = \"sobol\""), "sampling: "),
        (refused("[[margin]]\nfind = \"most\""), "margin[0].find: "),
        (refused("repeats = 1000000001"), "repeats: 1000000001 "),
        (refused("name = \"A b\"\nbase = \"rigid-pair\""), "name: `A b`"),
        (refused("name = \"a\"\nbase = \"rigid\""), "map.toml:2: base: there is no `rigid`; take another"),
        (refused("[[axis]]\nkey = \"a.b\"\nvalues = [1]\n[[axis]]\nkey = \"a\"\nvalues = [1]"), "axis[1].key: `a.b`"),
        // An error of every case refuses the campaign.
        (
            refused("[[axis]]\nkey = \"controller.gain\"\nvalues = [1.0, 2.0]"),
            "map.toml:4: controller.gain: unknown key; did you mean `gain_per_s`?",
        ),
        (refused("[[axis]]\nkey = \"fault.0.ticks\"\nvalues = [1]"), "map.toml:4: fault"),
        (refused("[[axis]]\nkey = \"name\"\nfactor = true\nvalues = [2]"), "map.toml:4: name: "),
        (refused("[set]\ntick_hz = -1.0"), "map.toml:4: tick_hz: -1"),
    ] {
        assert!(found.contains(expected), "{found}\nshould contain {expected}");
    }
}

proptest! {
    #[test]
    fn every_kind_of_axis_stays_within_its_bounds(
        seed: u32,
        sampling in prop::sample::select(vec!["random", "latin-hypercube", "sobol"]),
        low in 0.1..10.0_f64,
        width in 0.1..10.0_f64,
        number in 0..64_u64,
    ) {
        let (high, first, last) = (low + width, low as i64, low as i64 + 7);
        let axis = |key: &str, values: String| format!("[[axis]]\nkey = \"{key}\"\n{values}\n");
        let text = format!("name = \"map\"\nbase = \"rigid-pair\"\nseed = {seed}\nsamples = 64\nsampling = \"{sampling}\"\n")
            + &axis("a", format!("random = {{ uniform = [{low:?}, {high:?}] }}"))
            + &axis("b", format!("random = {{ log_uniform = [{low:?}, {high:?}] }}"))
            + &axis("c", format!("range = {{ from = {low:?}, to = {high:?}, points = 5 }}"))
            + &axis("d", format!("random = {{ uniform = [{first}, {last}] }}"))
            + &axis("e", "values = [\"x\", \"y\", true]".to_owned())
            + &axis("f", "random = { normal = [0.0, 1.0] }".to_owned());
        let file = Document::parse(&text, "map.toml").unwrap();
        let raw: Raw = file.read_into().unwrap();
        let mut checks = Checks::new(&file);
        let axes: Vec<Varied> = raw.axis.iter().enumerate()
            .map(|(index, axis)| Varied::resolve(axis, index, &file, &mut checks).unwrap()).collect();
        let kinds: Vec<AxisKind> = axes.iter().map(|varied| varied.axis.kind).collect();
        prop_assert_eq!(&kinds[..3], &[AxisKind::Linear, AxisKind::Log, AxisKind::Linear]);
        let samples = Some((raw.sampling.unwrap(), 64));
        let campaign = campaign("name = \"map\"\nbase = \"rigid-pair\"").with_axes(axes, samples, raw.seed);
        let case = campaign.case(number).unwrap();
        let value = |axis: usize| case.parameters[axis].number();
        prop_assert!((0..3).all(|axis| value(axis).is_some_and(|value| low <= value && value <= high * (1.0 + 1e-15))));
        let steps = (value(2).unwrap() - low) / width * 4.0;
        prop_assert!((steps - steps.round()).abs() < 1e-9, "one of the points: {steps}");
        prop_assert!(matches!(case.parameters[3], Parameter::Whole(whole) if first <= whole && whole <= last));
        prop_assert!(value(4).is_none() && value(5).is_some_and(f64::is_finite));
        prop_assert!(case.seed < 1 << SEED_BITS);
        prop_assert_eq!(campaign.case(number), campaign.case(number));
    }
}
