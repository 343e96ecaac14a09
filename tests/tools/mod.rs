//! Uses the other commands, the help and every command of the manual as a user does.

mod bench;
mod campaign;
mod campaign_page;
mod command_line;
mod doctor;
mod documents;
#[cfg(feature = "foxglove")]
mod foxglove;
mod late;
mod report;
mod report_inputs;
mod watch;
