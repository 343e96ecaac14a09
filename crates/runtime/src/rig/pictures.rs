//! The pictures of a rig's motion in a report: their fields, axes and captions.
//!
//! This file draws nothing.

use crate::bus::Signal;
use crate::sample::{Field, FieldKind, Sample};

/// A picture of the motion.
#[derive(Debug, Clone)]
pub enum Picture {
    /// The paths of every body, and of the observed body's estimate, in a plane.
    Plane(Plane),
    /// An element of every body's truth, and of the observed body's estimate, over time.
    Graph(Graph),
    /// The command asked for, and the one that acts: one picture per driven body, two lines per component.
    Inputs(Inputs),
    /// A Lyapunov function published with commands ([`super::Rig::lyapunov`]), in a section of its own.
    Lyapunov(Lyapunov),
    /// The errors over the logarithm of time, which resolves the first ticks.
    Onset,
}

/// Paths in a plane.
#[derive(Debug, Clone)]
pub struct Plane {
    /// The title, unique among the pictures of the rig.
    pub title: &'static str,
    /// The names of the axes, with their units.
    pub axes: [&'static str; 2],
    /// The caption.
    pub caption: &'static str,
    /// Returns the point of a sample, from a function that returns an element of a field by name and index.
    pub point: Point,
    /// True if the origin is marked and both axes have the same scale.
    pub centred: bool,
    /// The caption of the comparison with [its counterpart](super::Rig::counterpart), which draws only the observed body.
    pub compared: Option<&'static str>,
}

/// The function of [`Plane::point`]: `None` if the sample lacks a field.
pub type Point = fn(&dyn Fn(&str, usize) -> Option<f64>) -> Option<[f64; 2]>;

/// An element of a field over time.
#[derive(Debug, Clone)]
pub struct Graph {
    /// The title.
    pub title: String,
    /// The field of truths, and of the estimate if it has the same field.
    pub field: &'static str,
    /// The index of the element.
    pub element: usize,
    /// The name of the axis, with its unit.
    pub axis: String,
    /// The caption.
    pub caption: String,
}

/// A field of commands over time, beside what acts of it.
#[derive(Debug, Clone)]
pub struct Inputs {
    /// The field of commands.
    pub field: &'static str,
    /// The signal and the field in which a body reports what acts.
    pub applied: (Signal, &'static str),
    /// The name of the axis, with its unit.
    pub axis: String,
    /// The names of its elements.
    pub components: Vec<String>,
}

/// A Lyapunov function V and its rate of decrease.
#[derive(Debug, Clone, Copy)]
pub struct Lyapunov {
    /// The field of commands that is V.
    pub field: &'static str,
    /// The names of the axes of V and of −dV/dt, with their units.
    pub axes: [&'static str; 2],
    /// The definition of V.
    pub function: &'static str,
    /// The bound on the decrease of V.
    pub bound: &'static str,
}

/// Returns a graph over time of every number of a truth, named after its fields and units, and of every command that the truth or the
/// measurement reports as it acts: in a field with its name, or with the prefix `applied_`.
pub fn graphs<T: Sample, M: Sample, C: Sample>() -> Vec<Picture> {
    let graph = |field: &Field, element: usize| {
        let (name, axis) = (component(field, element), axis(&component(field, element), field));
        let title = format!("{name} over time");
        Picture::Graph(Graph { title, field: field.name, element, axis: axis.clone(), caption: format!("{axis}.") })
    };
    let inputs = |field: &Field| {
        let signals = [(Signal::Truth, T::FIELDS), (Signal::Measurement, M::FIELDS)];
        let mut reported = signals.into_iter().flat_map(|(signal, fields)| fields.iter().map(move |own| (signal, own)));
        let (signal, report) = reported.find(|(_, report)| {
            let same = applied(report).unwrap_or(report.name) == field.name;
            same && (report.kind, report.count) == (field.kind, field.count)
        })?;
        Some(Picture::Inputs(Inputs {
            field: field.name,
            applied: (signal, report.name),
            axis: axis(&named(field.name).0, field),
            components: (0..field.count).map(|element| component(field, element)).collect(),
        }))
    };
    // Drawn beside what was asked for.
    let acts = |field: &&Field| applied(field).is_some_and(|name| numbers::<C>().any(|command| command.name == name));
    let graphs = numbers::<T>().filter(|field| !acts(field));
    let graphs = graphs.flat_map(|field| (0..field.count).map(move |element| graph(field, element)));
    graphs.chain(numbers::<C>().filter_map(inputs)).collect()
}

/// Returns the name of the command's field whose applied value a field reports.
fn applied(field: &Field) -> Option<&'static str> {
    field.name.strip_prefix("applied_")
}

fn numbers<S: Sample>() -> impl Iterator<Item = &'static Field> {
    S::FIELDS.iter().filter(|field| field.kind == FieldKind::F64)
}

/// Returns the name of an element of a field.
fn component(field: &Field, element: usize) -> String {
    let (name, _) = named(field.name);
    if field.count > 1 { format!("{name} {}", element + 1) } else { name }
}

/// Returns the name of an axis with the unit of a field.
fn axis(name: &str, field: &Field) -> String {
    let (_, unit) = named(field.name);
    if unit.is_empty() { name.to_owned() } else { format!("{name}, {unit}") }
}

/// The units that may end a field's name, and their symbols.
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

/// Splits a field's name into words and unit: `load_torque_n_m` is `load torque` in `N m`, `speed_rad_s` is `speed` in `rad/s`.
pub fn named(field: &str) -> (String, String) {
    let parts: Vec<&str> = field.split('_').collect();
    // A name has at least one word before its unit.
    let words = 1 + parts[1..].iter().rposition(|part| unit(part).is_none()).map_or(0, |last| last + 1);
    let mut symbols = String::new();
    for part in &parts[words..] {
        let (text, power) = unit(part).unwrap_or_default();
        let divides = text == "s" && !symbols.is_empty();
        symbols += if divides { "/" } else { "" };
        symbols += if symbols.is_empty() || divides { "" } else { " " };
        symbols += text;
        symbols += power;
    }
    (parts[..words].join(" "), symbols)
}

/// Returns the unit and power of a part of a name, if it is one.
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
