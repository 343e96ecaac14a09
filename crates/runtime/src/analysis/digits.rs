//! Formats numbers with their significant digits. Must not judge them.

/// Formats a number with at least four significant digits, however small it is.
pub fn digits(value: f64) -> String {
    let decimals = match value.abs() {
        0.1..1e6 => 4,
        0.01..0.1 => 5,
        1e-3..0.01 => 6,
        0.0 => return "0".to_owned(),
        _ => return format!("{value:.3e}"),
    };
    let text = format!("{value:.decimals$}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Formats a number with one decimal more than its tolerance has; a whole number gets no decimals.
pub fn to_tolerance(value: f64, tolerance: f64) -> String {
    let power = |value: f64| value.abs().log10().floor() as i32;
    let last = power(tolerance) - 1;
    if value.fract() == 0.0 && value.abs() < 1e15 {
        format!("{value:.0}")
    } else if (1e-3..1e15).contains(&value.abs()) {
        format!("{value:.*}", (-last).clamp(0, 17) as usize)
    } else {
        format!("{value:.*e}", (power(value) - last).clamp(0, 17) as usize)
    }
}

/// Formats two numbers for comparison, with enough digits to distinguish them.
pub fn apart(a: f64, b: f64) -> [String; 2] {
    let few = [a, b].map(digits);
    if few[0] == few[1] { [a, b].map(|value| value.to_string()) } else { few }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tolerance_sets_the_number_of_digits() {
        for (value, tolerance, text) in [
            (0.5541015625000001, 0.01, "0.554"),
            (3.642_089_843_75, 0.5, "3.64"),
            (-12.26, 5.0, "-12.3"),
            (41.0, 5.0, "41"),
            (0.0, 0.01, "0"),
            (123_456.7, 1000.0, "123457"),
            (5.123_456_789e-6, 1e-9, "5.1235e-6"),
            (1e-5, 0.01, "1e-5"),
            (1e20, 1.0, "1.00000000000000000e20"),
        ] {
            assert_eq!(to_tolerance(value, tolerance), text);
        }
    }

    #[test]
    fn small_numbers_have_digits() {
        let texts = [0.0, 4.0, 0.25, 0.0123456, 0.002, 1.5e-7, -2e-4].map(digits);
        assert_eq!(texts, ["0", "4", "0.25", "0.01235", "0.002", "1.500e-7", "-2.000e-4"]);
        assert_eq!(apart(1.0, 0.99999), ["1", "0.99999"]);
        assert_eq!(apart(0.5, 0.25), ["0.5", "0.25"]);
    }
}
