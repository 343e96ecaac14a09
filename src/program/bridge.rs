//! `corotate bridge`: a device behind a serial line, in a role's seat.

use super::output::{Ended, Exit, Failure, fail, say};
use super::runs::join;
use crate::launch::line_words;
use crate::runtime::{DeviceConfig, DeviceError, NodeError};
use crate::seat::{BridgeResult, RoleError, run_bridge};
use crate::system::tell;
use std::path::PathBuf;

/// Options of `corotate bridge`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The device's serial line, as /dev/ttyUSB0 or a pty; set to raw mode, eight bits, no parity
    #[arg(long, value_name = "PATH")]
    serial: PathBuf,
    /// Its speed, bit/s [default: as it is]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(50..=20_000_000))]
    baud: Option<u32>,
    /// The role whose seat the device takes: a driven body's name, observer, controller, or observer,controller
    #[arg(long, value_name = "NAME", value_delimiter = ',', required = true, alias = "body")]
    role: Vec<String>,
    /// The run: its domain, as `corotate run --external NAME` prints it, or the directory that its results go to [default: the newest run of this user]
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// How long a device that is silent or gone is waited for, s
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    patience: f64,
    /// Go on if a device of another name answers in the midst of the run
    #[arg(long)]
    allow_other_device: bool,
    /// Print the line's counters at the end as one JSON object (corotate/bridge/v1)
    #[arg(long)]
    json: bool,
    /// Die with this process
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/bridge/v1";

const EXAMPLES: &str = "\
Example:
  corotate run pair.toml --external follower      prints DIR
  corotate bridge --serial /dev/ttyACM0 --role follower --domain DIR";

fn seconds(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|error| format!("{error}; give a number of seconds"))?;
    let sensible = (0.001..=86_400.0).contains(&value);
    sensible.then_some(value).ok_or_else(|| "give 0.001 to 86400 s".to_owned())
}

/// Serves the seat to the end of the run.
pub fn bridge(arguments: &Arguments) -> Ended {
    let (domain, terminated) = join(arguments.parent, arguments.domain.as_deref())?;
    let seat = DeviceConfig {
        domain,
        roles: arguments.role.clone(),
        path: arguments.serial.clone(),
        baud: arguments.baud,
        patience_s: arguments.patience,
        other_device: arguments.allow_other_device,
    };
    let role = seat.roles.join(",");
    let welcomed = |device: &str| tell(format_args!("{role} on {}: {device}", seat.path.display()));
    let served = run_bridge(&seat, &terminated, welcomed).map_err(|error| fail(exit_of(&error), error))?;
    let Some(BridgeResult { counters, outages, lost }) = served else { return Ok(Exit::Ok) };
    if arguments.json {
        let object = serde_json::json!({ "schema": SCHEMA, "role": role, "line": counters, "outages": outages });
        say(&format!("{object}\n"))?;
    } else {
        tell(line_words(&role, &counters));
    }
    Ok(lost.map_or(Exit::Ok, |lost| fail(Exit::ProcessLost, Failure::new("device-lost", format!("{role}: {lost}")))))
}

fn exit_of(error: &RoleError) -> Exit {
    match error {
        RoleError::Domain(_) | RoleError::Config(_) | RoleError::NoSuchRole { .. } | RoleError::NoDevice { .. } => {
            Exit::Usage
        }
        // A device that should be there and does not answer is a failure; one that is not what was asked for is usage.
        RoleError::Device(DeviceError::Silent { .. }) => Exit::Failure,
        RoleError::Device(_) => Exit::Usage,
        // It took part in the run, and is lost to it.
        RoleError::Node(NodeError::Device(_)) => Exit::ProcessLost,
        _ => Exit::Failure,
    }
}
