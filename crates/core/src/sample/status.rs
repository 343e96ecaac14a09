//! The bits of a sample's status word.

/// The plant received no command for this tick in time and holds the last one.
pub const HOLDING: u64 = 1 << 0;
/// The plant applies its safe command.
pub const SAFE: u64 = 1 << 1;
/// The estimate is the configured guess: nothing has been observed yet.
pub const INITIAL: u64 = 1 << 2;
/// The motion carried no information about the unknown since the last sample: the estimate advanced by the model
/// alone.
pub const UNOBSERVABLE: u64 = 1 << 3;
/// The measurement lacked a required component or was not finite. The estimate advanced by the model alone, or
/// stayed if the model is still being learned.
pub const UNUSABLE: u64 = 1 << 4;
/// The observer learns the body's inertia while all components are measured.
pub const LEARNING: u64 = 1 << 5;
/// The observer supplies a component that is not measured any more.
pub const AXIS_LOST: u64 = 1 << 6;
/// The component was lost before the inertia had been learned: the estimate is bounded but not reliable.
pub const DEGRADED: u64 = 1 << 7;
/// The motion does not excite the identifier.
pub const NOT_EXCITED: u64 = 1 << 8;
/// The body reached a limit of its model (a collision or an escape) and is frozen at its last valid state.
pub const FAULT: u64 = 1 << 9;
/// The input of this tick arrived but was not accepted: not finite, of an impossible generation, or physically
/// impossible. It is treated as missing.
pub const REJECTED: u64 = 1 << 10;
/// A sensor has no new value at this tick: a field of the measurement holds an earlier one, and [`held`] tells which. In an
/// estimate: it advanced by the model alone for this reason.
pub const HELD: u64 = 1 << 11;

/// The most fields after the stamp that can have a sensor of their own rate.
pub const HELD_FIELDS: usize = 32;

/// Returns the bit that tells that a field holds an earlier value. `field` counts the fields after the stamp from 0; it is below
/// [`HELD_FIELDS`].
pub const fn held(field: usize) -> u64 {
    if field < HELD_FIELDS { 1 << (HELD_FIELDS + field) } else { 0 }
}

/// All bits with their names, but for those of [`held`].
pub const NAMES: [(&str, u64); 12] = [
    ("holding", HOLDING),
    ("safe", SAFE),
    ("initial", INITIAL),
    ("unobservable", UNOBSERVABLE),
    ("unusable", UNUSABLE),
    ("learning", LEARNING),
    ("axis_lost", AXIS_LOST),
    ("degraded", DEGRADED),
    ("not_excited", NOT_EXCITED),
    ("fault", FAULT),
    ("rejected", REJECTED),
    ("held", HELD),
];
