//! The flight computer: observer and controller of the library, the same as on the host.

use crate::pair;
use corotate::rate::{HiddenObserver, RateLaw};
use corotate::serial::{DeviceFlightComputer, Hello};

/// The name of the device: kind and version.
pub const NAME: &str = "flight computer 1";

/// Returns both roles at their initial states, if the host asks for them.
pub fn make_role(hello: &Hello<'_>) -> Option<DeviceFlightComputer<HiddenObserver, RateLaw, 1>> {
    let asked = hello.role == "observer controller";
    let law = pair::law(hello.period_ns as f64 / 1e9)?;
    asked.then_some(DeviceFlightComputer::new(pair::observer()?, [law], hello))
}
