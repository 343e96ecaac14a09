//! Compares motion, estimates and the closed loop with references that share no code with them.

mod contest;
mod gyro_loss;
mod identification;
mod mathematics;
mod noise;
mod orbit;
mod rates;
mod reference_loop;
