//! The role processes of a run, and the seat description for programs that take a role.
//!
//! | file | duty |
//! |---|---|
//! | `process` | a role of this program, or of a function, from its start to its report |
//! | `bridge` | a device in the place of a role |
//! | `server` | a role whose samples another program computes, over a socket |
//! | `description` | the seat description for foreign programs |
//! | `paths`, `error` | the files of a run's domain; failures |

mod bridge;
mod description;
mod error;
mod paths;
mod process;
mod server;

pub use bridge::{BridgeResult, run_bridge};
pub use description::{SeatDescription, describe_seat, join_run, seat_path};
pub use error::RoleError;
#[cfg(feature = "hosts")]
pub use paths::clock_path;
pub use paths::{
    SUMMARY, changes_path, device_failure_path, failure_path, find_run, listening_process, open_ledger, panic_path,
    report_path, results_path, scenario_of, scenario_path, write_whole,
};
#[cfg(feature = "hosts")]
pub use process::join;
pub use process::{RoleAddress, RoleEnvironment, join_complete, run_function, run_role, serve};
pub use server::{SEAT_PROTOCOL, serve_seat};
