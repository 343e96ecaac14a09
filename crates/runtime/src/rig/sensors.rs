//! The sensors of a body: fields of its measurement hold their last value while their sensors have no new one.

use crate::config::{Sensor, Settings};
use crate::role::{Body, SingleBody};
use crate::sample::status::{HELD, HELD_FIELDS, held};
use crate::sample::{Field, Message, Sample, field_named, is_number};
use crate::state::{Persist, Words};

/// The sensors of a body that are slower than the tick, with their last values.
#[derive(Debug, Default)]
pub struct Sensors {
    sensed: Vec<Sensed>,
    fields: &'static [Field],
    /// The index of the word `status`.
    status: usize,
    /// The last measurement, and its tick; empty without slower sensors.
    last: Vec<u64>,
    last_tick: Option<u64>,
}

#[derive(Debug)]
struct Sensed {
    sensor: Sensor,
    /// The first word, and the number of words.
    first: usize,
    count: usize,
    /// The status bit of the field.
    bit: u64,
}

impl Sensors {
    /// Returns the slower sensors of a body whose measurement is of type `M`.
    pub fn new<M: Sample>(settings: &Settings, body: &str) -> Self {
        let sensed: Vec<Sensed> = settings.sensors.iter().filter_map(|sensor| sensed::<M>(sensor, body)).collect();
        let words = if sensed.is_empty() { 0 } else { size_of::<M>() / size_of::<u64>() };
        let status = M::STATUS_WORD.unwrap_or_default();
        Self { sensed, fields: M::FIELDS, status, last: vec![0; words], last_tick: None }
    }

    /// Replaces the fields without a new value at this tick by their last values, and sets their status bits.
    #[inline]
    pub fn hold(&mut self, tick: u64, words: &mut [u64]) {
        if !self.sensed.is_empty() {
            self.hold_any(tick, words);
        }
    }

    #[inline(never)]
    fn hold_any(&mut self, tick: u64, words: &mut [u64]) {
        for Sensed { sensor, first, count, bit } in &self.sensed {
            let is_new = |last| sensor.values_until(tick) > sensor.values_until(last);
            if !self.last_tick.is_none_or(is_new) {
                words[*first..][..*count].copy_from_slice(&self.last[*first..][..*count]);
                words[self.status] |= HELD | bit;
            }
        }
        self.last.copy_from_slice(words);
        self.last_tick = Some(tick);
    }
}

/// Finds the field of a sensor of this body. The scenario's checks refuse a sensor without one.
fn sensed<M: Sample>(sensor: &Sensor, body: &str) -> Option<Sensed> {
    let index = field_named(M::FIELDS, &sensor.field).filter(|index| *index < HELD_FIELDS)?;
    let field = M::FIELDS[index];
    let slow = sensor.body == body && sensor.every_ticks > 1 && M::STATUS_WORD.is_some();
    let (first, count) = (field.offset / size_of::<u64>(), field.count);
    slow.then(|| Sensed { sensor: sensor.clone(), first, count, bit: held(index) })
}

impl Persist for Sensors {
    fn persist<W: Words>(&mut self, words: &mut W) {
        if !self.sensed.is_empty() {
            let fields = self.fields;
            words.sample(&mut self.last, |word| is_number(fields, word));
            self.last_tick.persist(words);
        }
    }
}

/// A body with its slower sensors.
#[derive(Debug)]
pub struct SensedBody<B> {
    body: B,
    sensors: Sensors,
}

impl<B: SingleBody> SensedBody<B> {
    /// Adds the slower sensors of the body with this name.
    pub fn new(body: B, settings: &Settings, name: &str) -> Self {
        Self { body, sensors: Sensors::new::<B::Measurement>(settings, name) }
    }
}

impl<B: SingleBody> Body for SensedBody<B> {
    type Truth = B::Truth;
    type Measurement = B::Measurement;
    type Command = B::Command;

    #[inline]
    fn apply(&mut self, command: &B::Command) -> bool {
        self.body.apply(command)
    }

    #[inline]
    fn apply_safe(&mut self) {
        self.body.apply_safe();
    }

    #[inline]
    fn truth(&self, status: u64, out: &mut B::Truth) {
        self.body.truth(status, out);
    }

    #[inline]
    fn measure(&mut self, tick: u64, status: u64, out: &mut B::Measurement) {
        self.body.measure(tick, status, out);
    }

    #[inline]
    fn hold(&mut self, tick: u64, out: &mut B::Measurement) {
        self.body.hold(tick, out);
        self.sensors.hold(tick, out.words_mut());
    }

    #[inline]
    fn flow(&mut self, dt_s: f64) {
        self.body.flow(dt_s);
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        self.body.set_input(port, values);
    }
}

impl<B: Persist> Persist for SensedBody<B> {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.body.persist(words);
        self.sensors.persist(words);
    }
}
