//! `corotate bridge`: connects a device on a serial line or at a UDP address to a run, as a role.

use super::output::{CommandResult, Exit, Failure, fail, say};
use super::runs::join;
use crate::launch::{line_words, pace_words};
use crate::runtime::{DeviceConfig, DeviceError, LineAddress, NodeError, OnLost, PaceOptions};
use crate::seat::{BridgeResult, RoleError, run_bridge};
use crate::system::tell;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Options of `corotate bridge`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Serial line, such as /dev/ttyUSB0; set to raw mode, eight bits, no parity
    #[arg(long, value_name = "PATH", required_unless_present = "udp", conflicts_with = "udp")]
    serial: Option<PathBuf>,
    /// Speed of the line, bit/s [default: unchanged]
    #[arg(long, value_name = "N", conflicts_with = "udp", value_parser = clap::value_parser!(u32).range(50..=20_000_000))]
    baud: Option<u32>,
    /// Address of a device that receives datagrams, such as 127.0.0.1:7700 or [::1]:7700
    #[arg(long, value_name = "ADDR")]
    udp: Option<SocketAddr>,
    /// Accept a UDP address beyond loopback; its frames are not authenticated (insecure)
    #[arg(long, requires = "udp", hide_short_help = true)]
    insecure: bool,
    /// Role of the device: a driven body's name, observer, controller, or observer,controller
    #[arg(long, value_name = "NAME", value_delimiter = ',', required = true, alias = "body")]
    role: Vec<String>,
    /// The run's domain or results directory; `run --external NAME` prints the domain [default: your newest run]
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Wait this long for a silent or disconnected device, s
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    patience: f64,
    /// Continue if a device of another name answers during the run
    #[arg(long, hide_short_help = true)]
    allow_other_device: bool,
    /// Clock of the run: that of the host, or of the device, which sends a frame in each of its cycles
    #[arg(long, value_name = "CLOCK", default_value = "host")]
    pace: PaceBy,
    /// With `--pace device`, keep the pace of a silent device for this time, s
    #[arg(long, value_name = "S", default_value_t = 5.0, value_parser = seconds, hide_short_help = true)]
    holdover: f64,
    /// With `--pace device`, then send no commands until the device is followed again (safe), or end the run (stop)
    #[arg(long, value_name = "POLICY", default_value = "safe", hide_short_help = true)]
    on_lost: LostPolicy,
    /// Print the line's counters as one JSON object (corotate/bridge/v1)
    #[arg(long)]
    json: bool,
    /// Die with this process
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

/// The clock of a run.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum PaceBy {
    Host,
    Device,
}

/// The reaction to a device that is silent for longer than the holdover.
#[derive(Clone, Copy, clap::ValueEnum)]
enum LostPolicy {
    Safe,
    Stop,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/bridge/v1";

const EXAMPLES: &str = "\
Examples:
  corotate run pair.toml --external follower      prints DIR
  corotate bridge --serial /dev/ttyACM0 --role follower --domain DIR
  corotate bridge --udp 127.0.0.1:7700 --role follower --domain DIR";

fn seconds(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|error| format!("{error}; give a number of seconds"))?;
    let sensible = (0.001..=86_400.0).contains(&value);
    sensible.then_some(value).ok_or_else(|| "give 0.001 to 86400 s".to_owned())
}

fn pace_options(arguments: &Arguments) -> PaceOptions {
    let on_lost = match arguments.on_lost {
        LostPolicy::Safe => OnLost::Safe,
        LostPolicy::Stop => OnLost::Stop,
    };
    PaceOptions { holdover_s: arguments.holdover, on_lost }
}

/// Returns the place of the device.
fn address(arguments: &Arguments) -> Result<LineAddress, Failure> {
    let Some(address) = arguments.udp else {
        let path = arguments.serial.clone().unwrap_or_default();
        return Ok(LineAddress::Serial { path, baud: arguments.baud });
    };
    if address.ip().is_loopback() || arguments.insecure {
        return Ok(LineAddress::Udp(address));
    }
    let text = format!(
        "frames to and from {address} are not authenticated; give a loopback address, which a tunnel may end at, or add \
         --insecure on a trusted network"
    );
    Err(Failure::new("open-address", text))
}

/// Connects the device to the end of the run.
pub fn bridge(arguments: &Arguments) -> CommandResult {
    let line = address(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
    let (domain, terminated) = join(arguments.parent, arguments.domain.as_deref())?;
    let device = DeviceConfig {
        domain,
        roles: arguments.role.clone(),
        line,
        patience_s: arguments.patience,
        other_device: arguments.allow_other_device,
        pace: (arguments.pace == PaceBy::Device).then(|| pace_options(arguments)),
    };
    let role = device.roles.join(",");
    let welcomed = |name: &str| tell(format_args!("{role} on {}: {name}", device.line));
    let served = run_bridge(&device, &terminated, welcomed).map_err(|error| fail(exit_of(&error), error))?;
    let Some(BridgeResult { counters, outages, pace, lost }) = served else { return Ok(Exit::Ok) };
    if arguments.json {
        let object =
            serde_json::json!({ "schema": SCHEMA, "role": role, "line": counters, "outages": outages, "pace": pace });
        say(&format!("{object}\n"))?;
    } else {
        tell(line_words(&role, &counters));
        pace.iter().for_each(|pace| tell(pace_words(&role, pace)));
    }
    Ok(lost.map_or(Exit::Ok, |lost| fail(Exit::ProcessLost, Failure::new("device-lost", format!("{role}: {lost}")))))
}

fn exit_of(error: &RoleError) -> Exit {
    match error {
        RoleError::Domain(_)
        | RoleError::Config(_)
        | RoleError::NoSuchRole { .. }
        | RoleError::NoDevice { .. }
        | RoleError::DeviceReadsOwn { .. } => Exit::Usage,
        // A silent device is a failure; a wrong device is a usage error.
        RoleError::Device(DeviceError::Silent { .. }) => Exit::Failure,
        RoleError::Device(_) => Exit::Usage,
        // Lost during the run.
        RoleError::Node(NodeError::Device(_)) => Exit::ProcessLost,
        _ => Exit::Failure,
    }
}
