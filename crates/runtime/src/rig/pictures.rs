//! What a report draws of a rig's motion: which fields, beside which, under which names.
//!
//! Must not draw.

use crate::sample::{Field, FieldKind, Sample};

/// A picture of the motion.
#[derive(Debug, Clone)]
pub enum Picture {
    /// Every body, and the estimate of the observed one, in a plane.
    Plane(Plane),
    /// Every body, and the estimate of the observed one, over time.
    Graph(Graph),
    /// What each driven body applied, a picture for each body, a line for each component.
    Inputs(Inputs),
    /// A Lyapunov function that commands tell ([`super::Rig::lyapunov`]), in a section of its own.
    Lyapunov(Lyapunov),
    /// The errors over the logarithm of time too, where what happens in the first ticks has room.
    Onset,
}

/// Paths in a plane.
#[derive(Debug, Clone)]
pub struct Plane {
    /// What it shows; no other picture of the rig has the same title.
    pub title: &'static str,
    /// The names of the axes, with their units.
    pub axes: [&'static str; 2],
    /// What a reader is told below it.
    pub caption: &'static str,
    /// Where a sample lies, from the elements of its fields by name and index; nowhere if it lacks one.
    pub point: Point,
    /// Whether the origin is marked, and both axes have one scale.
    pub centred: bool,
    /// Caption where the run is compared with [its counterpart](super::Rig::counterpart): only the observed body is drawn then.
    pub compared: Option<&'static str>,
}

/// See [`Plane::point`].
pub type Point = fn(&dyn Fn(&str, usize) -> Option<f64>) -> Option<[f64; 2]>;

/// An element of a field over time.
#[derive(Debug, Clone)]
pub struct Graph {
    /// What it shows.
    pub title: String,
    /// The field of truths, and of the estimate if that has it too.
    pub field: &'static str,
    /// Its element.
    pub element: usize,
    /// The name of the axis, with its unit.
    pub axis: String,
    /// What a reader is told below it.
    pub caption: String,
}

/// The components of a field over time.
#[derive(Debug, Clone)]
pub struct Inputs {
    /// The field of truths.
    pub field: &'static str,
    /// The name of the axis, with its unit.
    pub axis: &'static str,
    /// The names of its elements.
    pub components: &'static [&'static str],
}

/// V and how fast it falls.
#[derive(Debug, Clone, Copy)]
pub struct Lyapunov {
    /// The field of commands that is V.
    pub field: &'static str,
    /// The names of the axes of V and of −dV/dt, with their units.
    pub axes: [&'static str; 2],
    /// What V is.
    pub function: &'static str,
    /// What bounds its fall.
    pub bound: &'static str,
}

/// Every number of a truth over time, by the names and units of its fields.
pub fn graphs<S: Sample>() -> Vec<Picture> {
    let numbers = S::FIELDS.iter().filter(|field| field.kind == FieldKind::F64);
    let graph = |field: &Field, element: usize| {
        let (name, unit) = named(field.name);
        let name = if field.count > 1 { format!("{name} {}", element + 1) } else { name };
        let axis = if unit.is_empty() { name.clone() } else { format!("{name}, {unit}") };
        let title = format!("{name} over time");
        Picture::Graph(Graph { title, field: field.name, element, axis: axis.clone(), caption: format!("{axis}.") })
    };
    numbers.flat_map(|field| (0..field.count).map(move |element| graph(field, element))).collect()
}

/// The units that a field's name may end with, and how they are written.
const UNITS: [(&str, &str); 21] = [
    ("rad", "rad"),
    ("deg", "deg"),
    ("s", "s"),
    ("ms", "ms"),
    ("us", "µs"),
    ("ns", "ns"),
    ("hz", "Hz"),
    ("m", "m"),
    ("mm", "mm"),
    ("km", "km"),
    ("du", "du"),
    ("kg", "kg"),
    ("n", "N"),
    ("j", "J"),
    ("w", "W"),
    ("v", "V"),
    ("a", "A"),
    ("ohm", "Ω"),
    ("k", "K"),
    ("pa", "Pa"),
    ("t", "T"),
];

/// A field's name as words, and its unit: `load_torque_n_m` is `load torque` in `N m`, `speed_rad_s` is `speed` in `rad/s`.
pub fn named(field: &str) -> (String, String) {
    let parts: Vec<&str> = field.split('_').collect();
    // A name has at least one word before its unit.
    let words = 1 + parts[1..].iter().rposition(|part| unit(part).is_none()).map_or(0, |last| last + 1);
    let mut told = String::new();
    for part in &parts[words..] {
        let (text, power) = unit(part).unwrap_or_default();
        let divides = text == "s" && !told.is_empty();
        told += if divides { "/" } else { "" };
        told += if told.is_empty() || divides { "" } else { " " };
        told += text;
        told += power;
    }
    (parts[..words].join(" "), told)
}

/// A part of a name as a unit and its power, if it is one.
fn unit(part: &str) -> Option<(&'static str, &'static str)> {
    let (name, power) = match part.strip_suffix(['2', '3']) {
        Some(name) if part.ends_with('2') => (name, "²"),
        Some(name) => (name, "³"),
        None => (part, ""),
    };
    UNITS.iter().find(|(known, _)| *known == name).map(|(_, text)| (*text, power))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_unit_is_the_last_part_of_a_name() {
        for (field, name, unit) in [
            ("speed_rad_s", "speed", "rad/s"),
            ("load_torque_n_m", "load torque", "N m"),
            ("applied_rad_s2", "applied", "rad/s²"),
            ("inertia_kg_m2", "inertia", "kg m²"),
            ("time_s", "time", "s"),
            ("coefficient", "coefficient", ""),
            ("m", "m", ""),
            ("n_m_of_load", "n m of load", ""),
        ] {
            assert_eq!(named(field), (name.to_owned(), unit.to_owned()), "{field}");
        }
    }
}
