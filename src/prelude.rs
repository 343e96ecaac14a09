//! What a crate with its own rig usually needs: `use corotate::prelude::*;`.

pub use crate::Program;
pub use crate::config::{BodyInfo, Checks, InputInfo, InputUser, Variability};
pub use crate::model::{Noise, quantize, rk4_step};
pub use crate::rig::{Context, Difference, SimpleRig};
pub use crate::role::{Actuated, Body, Dynamics, Estimator, InvariantRelation, Law, LawInputs, RelationObserver};
pub use crate::sample::Applied;
pub use crate::{libm, nalgebra, persist_fields, sample};
