//! Formatting of numbers on the page of a campaign.

/// Formats a number with three significant digits; infinity, the value of a lost body, as `lost`.
pub fn few(value: f64) -> String {
    if value.is_infinite() {
        return "lost".to_owned();
    }
    let size = value.abs();
    if value == 0.0 || (1e-3..1e6).contains(&size) {
        let decimals = if size >= 100.0 { 1 } else { 2 - size.max(1e-3).log10().floor() as i32 }.max(0) as usize;
        let text = format!("{value:.decimals$}");
        return if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text };
    }
    let text = format!("{value:.2e}");
    let (mantissa, exponent) = text.split_once('e').unwrap_or((&text, "0"));
    let mantissa = mantissa.trim_end_matches('0').trim_end_matches('.');
    format!("{mantissa}e{exponent}")
}
