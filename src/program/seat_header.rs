//! The samples of a seat as a C header, for programs that take a role with libcorotate.
//!
//! The structs have the content of the samples, without their stamps, as libcorotate copies them. This file must not know a rig.

use crate::bus::Port;
use crate::runtime::{RoleId, ports};
use crate::sample::{Field, FieldKind};
use crate::scenario::Scenario;
use std::fmt::Write;

/// The words of C and C++ that could be the name of a field.
const KEYWORDS: [&str; 24] = [
    "auto", "bool", "case", "char", "class", "default", "delete", "double", "explicit", "export", "float", "friend",
    "goto", "inline", "int", "long", "new", "operator", "register", "short", "signed", "switch", "this", "volatile",
];

/// Returns the header of a role.
pub fn header(scenario: &Scenario, role: RoleId) -> String {
    let (name, ports) = (role.name(scenario), ports(scenario, role));
    let guard = format!("COROTATE_{}_{}_H", upper(&scenario.name), upper(name));
    let mut text = format!(
        "/* The samples of the role {name} in the scenario {}: those that it reads, then those that it writes. */\n\
         #ifndef {guard}\n#define {guard}\n\n#include <assert.h>\n#include <stdint.h>\n",
        scenario.name
    );
    ports.reads.iter().chain(&ports.writes).for_each(|port| sample(port, &mut text));
    text + &format!("\n#endif /* {guard} */\n")
}

fn sample(port: &Port, text: &mut String) {
    let (body, signal) = (&port.topic.body, port.topic.signal.name());
    let name = format!("corotate_{}_{signal}", body.replace('-', "_"));
    let bytes: usize = port.fields.iter().map(|field| 8 * field.count).sum();
    // Writing to a string cannot fail.
    let _ = writeln!(text, "\n/* `{body}/{signal}`: {} */\nstruct {name} {{", port.layout);
    for Field { name, kind, count, .. } in &port.fields {
        let kind = if *kind == FieldKind::F64 { "double" } else { "uint64_t" };
        let keyword = if KEYWORDS.contains(name) { "_" } else { "" };
        let array = if *count == 1 { String::new() } else { format!("[{count}]") };
        let _ = writeln!(text, "    {kind} {name}{keyword}{array};");
    }
    let _ = writeln!(text, "}};\nstatic_assert(sizeof(struct {name}) == {bytes}, \"the layout of {body}/{signal}\");");
}

fn upper(name: &str) -> String {
    name.to_ascii_uppercase().replace('-', "_")
}
