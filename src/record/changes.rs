//! Writes the changes of inputs as messages of the signal `input`, so that foreign readers of a recording see them.
//!
//! Takes them from the list of the run: no sample of the signal can be lost. The recorder's metadata has them too, for replays.

use super::error::RecordError;
use super::taps::{Channel, MessageSink, about};
use crate::bus::Port;
use crate::changes::ReceivedChanges;
use crate::clock::{Grid, monotonic_ns};
use crate::config::ClockKind;
use crate::input::Change;
use crate::runtime::{RoleId, ports};
use crate::sample::{Layout, Message};
use crate::scenario::Scenario;
use std::sync::Arc;

/// The changes of a run that are not recorded yet.
pub(super) struct ChangeTap {
    port: Port,
    scripted: Arc<[Change]>,
    received: Arc<ReceivedChanges>,
    recorded: usize,
    /// Added with the first change: most recordings have none.
    channel: Option<Channel>,
    grid: Grid,
    realtime: bool,
}

impl ChangeTap {
    pub fn new(scenario: &Scenario) -> Self {
        Self {
            port: ports(scenario, RoleId::Observer(0)).input,
            scripted: scenario.inputs.scripted.clone(),
            received: scenario.inputs.received(),
            recorded: 0,
            channel: None,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            realtime: scenario.clock == ClockKind::Realtime,
        }
    }

    /// Sets the time of tick 0, ns.
    pub fn start(&mut self, epoch_ns: u64) {
        self.grid.epoch_ns = epoch_ns;
    }

    /// Passes on the changes since the last call.
    ///
    /// # Errors
    /// The sink's.
    pub fn drain(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError> {
        while let Some(change) = self.next() {
            let channel = match self.channel {
                Some(channel) => channel,
                None => {
                    let layout = Layout::from_fields(self.port.type_name, &self.port.fields);
                    *self.channel.insert(sink.channel(
                        &self.port.topic.to_string(),
                        &layout,
                        about(&self.port, "run"),
                    )?)
                }
            };
            let due_ns = self.grid.due_ns(change.tick);
            let logged_ns = if self.realtime { monotonic_ns() } else { due_ns };
            let sample = change.sample(self.recorded as u64);
            let body = bytemuck::cast_slice(sample.words());
            sink.message(channel, self.recorded as u32, due_ns, logged_ns, body)?;
            self.recorded += 1;
        }
        Ok(())
    }

    fn next(&self) -> Option<Change> {
        match self.recorded.checked_sub(self.scripted.len()) {
            None => self.scripted.get(self.recorded).copied(),
            Some(number) => self.received.get(number),
        }
    }
}
