//! Axes: map values to positions between 0 and 1, with ticks at round values.

/// The approximate number of labels on an axis, and on a time axis, which has room for more.
const LABELS: f64 = 7.0;
const TIME_LABELS: f64 = 10.0;
/// The largest number of decades on a logarithmic axis, counted from its top.
const DECADES: f64 = 36.0;

/// A logarithmic axis with fewer labels than this gets labels between its decades.
const FEW: usize = 3;
/// The largest number of letters of a name on an axis; the width and height of a letter, px.
const NAME: usize = 14;
const LETTER: f64 = 6.9;
const LINE: f64 = 17.0;

/// A range narrower than this fraction of its values is labelled by offsets from a common value.
const SAME: f64 = 1e-3;
/// The range of values that are written without an exponent.
const SMALL: f64 = 1e-2;
const LARGE: f64 = 1e5;

/// The scale of an axis with its label and ticks.
#[derive(Debug, Clone)]
pub struct Axis {
    /// The quantity, with its unit.
    pub label: String,
    low: f64,
    high: f64,
    logarithmic: bool,
    /// The marked values, with their labels.
    pub ticks: Vec<(f64, String)>,
}

impl Axis {
    /// Returns a linear axis between two values.
    pub fn linear(label: &str, low: f64, high: f64) -> Self {
        let (low, high) = widened(low, high);
        Self::marked(label, low, high, LABELS)
    }

    /// Returns a linear axis of the time in the run, s.
    pub fn time(end_s: f64) -> Self {
        let (low, high) = widened(0.0, end_s);
        Self::marked("time in the run, s", low, high, TIME_LABELS)
    }

    /// Returns a logarithmic axis of the time in the run, s, from the first tick on.
    pub fn log_time(tick_s: f64, end_s: f64) -> Self {
        let mut axis = Self::decades("time in the run, s, logarithmic", (tick_s, end_s));
        (axis.low, axis.high) = (tick_s.log10(), end_s.log10());
        axis.ticks.retain(|(value, _)| (tick_s..=end_s).contains(value));
        axis
    }

    fn marked(label: &str, low: f64, high: f64, labels: f64) -> Self {
        let (label, ticks) = linear_ticks(label, low, high, labels);
        Self { label, low, high, logarithmic: false, ticks }
    }

    /// Returns a linear axis with a margin of 5 % on either side of the values.
    pub fn around(label: &str, (low, high): (f64, f64)) -> Self {
        let (low, high) = widened(low, high);
        let room = 0.05 * (high - low);
        Self::linear(label, low - room, high + room)
    }

    /// Removes every other label, if there are many, for a plot of small height.
    pub fn sparse(mut self) -> Self {
        const MANY: usize = 4;
        if self.ticks.len() >= MANY {
            let mut kept = false;
            self.ticks.retain(|_| {
                kept = !kept;
                kept
            });
        }
        self
    }

    /// Returns a logarithmic axis of whole decades over positive values. Smaller values are drawn at its lower end.
    pub fn decades(label: &str, (low, high): (f64, f64)) -> Self {
        let high = if high > 0.0 && high.is_finite() { high.log10().ceil() } else { 0.0 };
        let low = if low > 0.0 && low.is_finite() { low.log10().floor() } else { high - 1.0 };
        let low = low.min(high - 1.0).max(high - DECADES);
        let step = ((high - low) / LABELS).ceil().max(1.0);
        let first = (low / step).ceil() as i32;
        let exponents = (first..).map(|n| n * step as i32).take_while(|exponent| f64::from(*exponent) <= high);
        let ticks = exponents.map(|exponent| (f64::from(exponent), power_of_ten(exponent))).collect();
        Self { label: label.to_owned(), low, high, logarithmic: true, ticks }.in_values()
    }

    /// Returns a logarithmic axis between two positive values, with labels between the decades if there are few decades.
    pub fn log_between(label: &str, low: f64, high: f64) -> Self {
        let mut axis = Self::decades(label, (low, high));
        let (bottom, top) = (low.log10(), high.log10());
        if !(bottom.is_finite() && top.is_finite() && top - bottom > 1e-9) {
            return axis;
        }
        (axis.low, axis.high) = (bottom, top);
        let (low, high) = (low * (1.0 - 1e-9), high * (1.0 + 1e-9));
        let within = |value: &f64| (low..=high).contains(value);
        axis.ticks.retain(|(value, _)| within(value));
        if axis.ticks.len() < FEW && top - bottom < 3.0 && low >= SMALL && high <= LARGE {
            let decades = (bottom.floor() as i32..=top.floor() as i32).map(|exponent| 10_f64.powi(exponent));
            let values = decades.flat_map(|decade| [1.0, 2.0, 5.0].map(|m| m * decade)).filter(within);
            axis.ticks = values.map(|value| (value, format!("{}", (value * 1e6).round() / 1e6))).collect();
        }
        if axis.ticks.len() < 2 {
            (axis.label, axis.ticks) = linear_ticks(label, low, high, LABELS);
            axis.ticks.retain(|(value, _)| within(value));
        }
        axis
    }

    /// Returns an axis of names at equal distances. If they do not fit into `room` px, only every n-th name is written.
    pub fn names(label: &str, names: &[String], room: f64, across: bool) -> Self {
        let longest = names.iter().map(|name| name.chars().count()).max().unwrap_or(0).min(NAME);
        let each = if across { LETTER * (longest as f64 + 1.5) } else { LINE };
        let stride = (each * names.len() as f64 / room).ceil().max(1.0) as usize;
        let tick = |(place, name): (usize, &String)| (place as f64, shortened(name));
        Self {
            label: label.to_owned(),
            low: -0.5,
            high: names.len().max(1) as f64 - 0.5,
            logarithmic: false,
            ticks: names.iter().enumerate().step_by(stride).map(tick).collect(),
        }
    }

    /// Returns an axis of 1/(1 − p), labelled by p in percent.
    pub fn percentiles(greatest: f64) -> Self {
        let greatest = greatest.max(10.0);
        let mut axis = Self::decades("percentile p, scaled by 1/(1 − p)", (1.0, greatest));
        axis.high = greatest.log10();
        axis.ticks.retain(|(value, _)| *value <= greatest);
        for (index, (_, label)) in axis.ticks.iter_mut().enumerate() {
            *label = match index {
                0 => "0 %".to_owned(),
                1 => "90 %".to_owned(),
                2 => "99 %".to_owned(),
                more => format!("99.{} %", "9".repeat(more - 2)),
            };
        }
        axis
    }

    /// Replaces the exponents in the ticks by their values.
    fn in_values(mut self) -> Self {
        self.ticks.iter_mut().for_each(|(value, _)| *value = 10_f64.powf(*value));
        self
    }

    /// Returns the position of a value: 0 at the lower end, 1 at the upper end. Values beyond an end are clamped to it.
    pub fn place(&self, value: f64) -> f64 {
        let value = if !self.logarithmic {
            value
        } else if value > 0.0 {
            value.log10()
        } else {
            f64::NEG_INFINITY
        };
        ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0)
    }

    /// The ends: values, or on a logarithmic axis their logarithms to base 10.
    pub fn ends(&self) -> [f64; 2] {
        [self.low, self.high]
    }

    /// Returns true if the axis is logarithmic.
    pub fn is_logarithmic(&self) -> bool {
        self.logarithmic
    }

    /// The smallest value on the axis.
    pub fn foot(&self) -> f64 {
        if self.logarithmic { 10_f64.powf(self.low) } else { self.low }
    }
}

/// Shortens a name to the letters that fit on an axis.
fn shortened(name: &str) -> String {
    if name.chars().count() <= NAME {
        return name.to_owned();
    }
    name.chars().take(NAME - 1).chain(['…']).collect()
}

/// Returns a range with finite ends and a width that is not zero.
fn widened(low: f64, high: f64) -> (f64, f64) {
    let bounded = |value: f64| if value.is_finite() { value.clamp(-1e30, 1e30) } else { 0.0 };
    let (low, high) = (bounded(low.min(high)), bounded(high.max(low)));
    let least = 1e-9 * low.abs().max(high.abs()).max(1e-6);
    if high - low < least { (low - least, high + least) } else { (low, high) }
}

/// Returns ticks at round values. Their common offset and power of ten are moved into the label of the axis.
fn linear_ticks(name: &str, low: f64, high: f64, labels: f64) -> (String, Vec<(f64, String)>) {
    let raw = (high - low) / (labels - 1.0);
    let decade = 10_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade).into_iter().find(|step| *step >= raw).unwrap_or(raw);
    let (first, last) = ((low / step - 1e-9).ceil(), (high / step + 1e-9).floor());
    let count = (last - first).clamp(0.0, 2.0 * labels) as usize;
    let value = |n: usize| {
        let value = (first + n as f64) * step;
        // Rounding must not give the label −0.
        if value.abs() < 1e-9 * step { 0.0 } else { value }
    };
    let values: Vec<f64> = (0..=count).map(value).collect();
    let largest = low.abs().max(high.abs());
    let coarse = 10.0 * step;
    let offset = if high - low < SAME * largest { ((low + high) / 2.0 / coarse).round() * coarse } else { 0.0 };
    let farthest = values.iter().map(|value| (value - offset).abs()).fold(0.0, f64::max);
    let plain = farthest == 0.0 || (SMALL..LARGE).contains(&farthest);
    let exponent = if plain { 0 } else { (farthest.log10() + 1e-6).floor() as i32 };
    let unit = 10_f64.powi(exponent);
    let digits = decimals(step / unit);
    let label = |value: f64| {
        let shown = (value - offset) / unit;
        let shown = if shown.abs() < 1e-9 * (step / unit) { 0.0 } else { shown };
        format!("{shown:.digits$}").replace('-', "−")
    };
    let (what, measured_in) = name.rsplit_once(", ").unwrap_or((name, ""));
    let mut title = what.to_owned();
    if offset != 0.0 {
        let sign = if offset < 0.0 { '+' } else { '−' };
        let digits = decimals(coarse);
        let text = format!("{:.digits$}", offset.abs());
        let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
        title = format!("{title} {sign} {text}");
    }
    let scale = if exponent == 0 { String::new() } else { power_of_ten(exponent) };
    let measured_in =
        [scale.as_str(), measured_in].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(" ");
    let title = if measured_in.is_empty() { title } else { format!("{title}, {measured_in}") };
    (title, values.into_iter().map(|value| (value, label(value))).collect())
}

/// Returns the number of decimals that distinguish multiples of a step.
fn decimals(step: f64) -> usize {
    (-(step.log10() + 1e-9).floor()).max(0.0) as usize
}

/// Formats a power of ten: 0.01 to 1000 as a number, any other with an exponent.
pub fn power_of_ten(exponent: i32) -> String {
    if (-2..=3).contains(&exponent) {
        return format!("{}", 10_f64.powi(exponent));
    }
    let raised = |digit: char| match digit {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32('⁰' as u32 + (digit as u32 - '0' as u32)).unwrap_or(digit),
    };
    format!("10{}", exponent.to_string().chars().map(raised).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<&str> {
        axis.ticks.iter().map(|(_, label)| label.as_str()).collect()
    }

    #[test]
    fn ticks_are_round_numbers_within_the_axis() {
        assert_eq!(labels(&Axis::time(10.0)), ["0", "2", "4", "6", "8", "10"]);
        assert_eq!(labels(&Axis::time(18.0)).len(), 10);
        assert_eq!(labels(&Axis::linear("w", -0.31, 0.62)), ["−0.2", "0.0", "0.2", "0.4", "0.6"]);
        assert_eq!(labels(&Axis::decades("e", (3e-5, 0.7))), ["10⁻⁵", "10⁻⁴", "10⁻³", "0.01", "0.1", "1"]);
        assert_eq!(labels(&Axis::percentiles(20_000.0))[..5], ["0 %", "90 %", "99 %", "99.9 %", "99.99 %"]);
    }

    /// Constant and nearly constant signals, and signals of rounding errors.
    #[test]
    fn labels_are_short_and_the_axis_label_has_the_offset_and_the_exponent() {
        let named = |low, high| {
            let axis = Axis::linear("ω1, rad/s", low, high);
            let (label, labels) = (axis.label.clone(), labels(&axis).join(" "));
            (label, labels)
        };
        assert_eq!(named(-1e-15, 1e-15), ("ω1, 10⁻¹⁵ rad/s".into(), "−1.0 −0.5 0.0 0.5 1.0".into()));
        assert_eq!(named(0.5, 0.5 + 1e-6), ("ω1 − 0.5, 10⁻⁶ rad/s".into(), "0.0 0.2 0.4 0.6 0.8 1.0".into()));
        assert_eq!(named(2e6, 2.1e6).0, "ω1, 10⁶ rad/s");
        assert_eq!(named(1.0, 1.0).0, "ω1 − 1, 10⁻⁹ rad/s");
        assert_eq!(Axis::linear("share", -3.0001, -3.0).label, "share + 3, 10⁻⁴");
        let values = [0.0, 1e-300, 1e-30, -1e-15, 3e-7, 0.877, 0.877 + 1e-9, -0.877, 12345.6, -7.7e12, 1e30];
        for (low, high) in values.into_iter().flat_map(|low| values.map(|high| (low, high))) {
            for (_, label) in Axis::around("x, m", (low, high)).ticks {
                assert!(label.chars().count() <= 8, "{low} {high}: {label}");
            }
        }
    }

    #[test]
    fn positions_are_within_the_axis_for_any_values() {
        let extreme = [0.0, -1.0, 1.0, 1e300, -1e300, f64::INFINITY, f64::NAN, f64::MIN_POSITIVE, 0.877, 0.877 + 1e-16];
        for low in extreme {
            for high in extreme {
                for axis in [Axis::linear("", low, high), Axis::around("", (low, high)), Axis::decades("", (low, high))]
                {
                    assert!(axis.ticks.len() < 40, "{axis:?}");
                    for value in extreme.into_iter().filter(|value| !value.is_nan()) {
                        assert!((0.0..=1.0).contains(&axis.place(value)), "{axis:?} {value}");
                    }
                }
            }
        }
    }

    #[test]
    fn decades_are_at_equal_distances_on_a_logarithmic_axis() {
        let axis = Axis::decades("", (1e-4, 1.0));
        assert!((axis.place(1e-2) - 0.5).abs() < 1e-12 && axis.place(0.0) == 0.0 && axis.place(1e9) == 1.0);
    }
}
