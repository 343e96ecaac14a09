//! The flight computer: observer and controller of the library, as they run on the host.

use crate::pair;
use corotate::rate::{HiddenObserver, RateLaw};
use corotate::serial::{DeviceFlightComputer, Hello};

/// What the device is called: kind and version.
pub const NAME: &str = "flight computer 1";

/// Both at their beginnings, if that is what the host asks for.
pub fn seat(hello: &Hello<'_>) -> Option<DeviceFlightComputer<HiddenObserver, RateLaw, 1>> {
    let asked = hello.role == "observer controller";
    let law = pair::law(hello.period_ns as f64 / 1e9)?;
    asked.then_some(DeviceFlightComputer::new(pair::observer()?, [law], hello))
}
