//! Publishes the changes of inputs as the signal `input`, for programs that do not read the shared list: those of the scenario at
//! the start, received ones as soon as they are in the list.
//!
//! Must publish a change before a role may come to its tick.

use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Signal, Write};
use crate::changes::ReceivedChanges;
use crate::clock::monotonic_ns;
use crate::runtime::topic;
use crate::sample::InputChange;
use crate::scenario::Scenario;
use std::sync::Arc;

/// The writer of the signal.
pub(super) struct ChangeSignal {
    writer: <IoxBus as Bus>::Writer<InputChange>,
    scripted: usize,
    received: Arc<ReceivedChanges>,
    /// The number of received changes that are published.
    published: usize,
}

impl ChangeSignal {
    /// Opens the signal and publishes the changes of the scenario.
    ///
    /// # Errors
    /// [`BusError`].
    pub fn open(scenario: &Scenario, bus: &IoxBus) -> Result<Self, BusError> {
        let inputs = &scenario.inputs;
        let writer = bus.writer(&topic(scenario, "run", Signal::Input), 1)?;
        let mut signal = Self { writer, scripted: inputs.scripted.len(), received: inputs.received(), published: 0 };
        let scripted = inputs.scripted.iter().enumerate();
        scripted.map(|(number, change)| change.sample(number as u64)).try_for_each(|sample| signal.send(sample))?;
        Ok(signal)
    }

    /// Publishes the changes received since the last call, and all changes to programs that joined since.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn publish(&mut self) -> Result<(), BusError> {
        self.writer.refresh()?;
        while let Some(change) = self.received.get(self.published) {
            self.send(change.sample((self.scripted + self.published) as u64))?;
            self.published += 1;
        }
        Ok(())
    }

    fn send(&mut self, change: InputChange) -> Result<(), BusError> {
        self.writer.send(|sample| {
            *sample = change;
            sample.stamp.sent_ns = monotonic_ns();
        })
    }
}
