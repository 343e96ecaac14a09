//! Least squares of Euler's equations in their weak form, \[SZ\](1), for a body whose principal axes are those of the sensor.
//!
//! ω_i(t) − ω̄_i = a_i (∫ω_j ω_k − mean) − c_i (∫ω_i − mean): each axis is linear in its coefficient a_i and in the
//! damping c_i of a torque −c_i I_i ω_i, such as that of the air. The three a_i are fitted separately, so that their
//! identity a1 + a2 + a3 + a1 a2 a3 = 0 is a check. The fit must not use that identity.

use super::motion::{FEATURES, Motion, PRODUCTS, Sums, TURNS};
use super::spread;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2, Vector3};

/// The least difference in direction at which two regressors can be separated.
const COLLINEAR: f64 = 1e-9;

/// The result of least squares for a body with known principal axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxesFit {
    /// The coefficients a of \[SZ\](1).
    pub coefficients: Vector3<f64>,
    /// The standard deviations of the coefficients, by resampling; absent if there are too few pieces.
    pub deviation: Option<Vector3<f64>>,
    /// The damping by a torque −c I ω, 1/s; zero unless it is fitted.
    pub damping_per_s: Vector3<f64>,
    /// The standard deviation of the damping, by resampling.
    pub damping_deviation_per_s: Option<Vector3<f64>>,
    /// The part of each rate's variance about its mean that the motion explains, at most 1.
    pub r_squared: Vector3<f64>,
    /// The residual of each rate, root mean square, rad/s.
    pub residual_rad_s: Vector3<f64>,
    /// The excitation of each coefficient: root mean square of the rate per unit of the coefficient, rad/s.
    pub excitation_rad_s: Vector3<f64>,
}

impl AxesFit {
    /// Computes a1 + a2 + a3 + a1·a2·a3: zero for every body.
    pub fn closure(&self) -> f64 {
        crate::model::closure(&self.coefficients)
    }
}

/// The fit of one axis.
#[derive(Debug, Clone, Copy)]
struct Axis {
    coefficient: f64,
    damping: f64,
    unexplained: f64,
    /// The part of the coefficient's regressor that is orthogonal to the damping's.
    excitation: f64,
}

impl Motion {
    /// Fits a body whose principal axes are the sensor's; with `damping`, the air's torque too.
    ///
    /// Returns `None` if the motion has no piece, or carries no information about an axis, or the body has a wheel.
    pub fn about_known_axes(&self, damping: bool) -> Option<AxesFit> {
        if self.has_wheel() {
            return None;
        }
        let total = self.total();
        let axes = fit(&total, damping)?;
        let scatter = total.scatter.diagonal();
        let samples = total.samples as f64;
        let part = |index: usize| {
            let whole = scatter[index];
            if whole > 0.0 { 1.0 - axes[index].unexplained / whole } else { 0.0 }
        };
        let spread = spread::over_groups(self, |sums| {
            let axes = fit(sums, damping)?;
            Some(SVector::<f64, 6>::from_fn(
                |row, _| {
                    if row < 3 { axes[row].coefficient } else { axes[row - 3].damping }
                },
            ))
        });
        Some(AxesFit {
            coefficients: Vector3::from_fn(|index, _| axes[index].coefficient),
            deviation: spread.map(|spread| spread.fixed_rows::<3>(0).into_owned()),
            damping_per_s: Vector3::from_fn(|index, _| axes[index].damping),
            damping_deviation_per_s: spread.map(|spread| spread.fixed_rows::<3>(3).into_owned()),
            r_squared: Vector3::from_fn(|index, _| part(index)),
            residual_rad_s: Vector3::from_fn(|index, _| libm::sqrt(axes[index].unexplained / samples)),
            excitation_rad_s: Vector3::from_fn(|index, _| libm::sqrt(axes[index].excitation / samples)),
        })
    }
}

/// Fits the three axes; `None` if the motion carries no information about one of them.
fn fit(sums: &Sums, damping: bool) -> Option<[Axis; 3]> {
    let fitted = [0, 1, 2].map(|index| fit_axis(&sums.scatter, index, damping));
    match fitted {
        [Some(x), Some(y), Some(z)] => Some([x, y, z]),
        _ => None,
    }
}

/// Solves the normal equations of one axis. Only the upper triangle of the scatter is filled.
fn fit_axis(scatter: &SMatrix<f64, FEATURES, FEATURES>, index: usize, damping: bool) -> Option<Axis> {
    // The products are in the order yz, zx, xy after the three squares.
    let (rate, product, turn) = (index, PRODUCTS + 3 + index, TURNS + index);
    let [xx, xy, yy] = [(product, product), (rate, product), (rate, rate)].map(|at| scatter[at]);
    if !(xx > 0.0 && xx.is_finite() && yy.is_finite()) {
        return None;
    }
    let (xt, tt, yt) = (-scatter[(product, turn)], scatter[(turn, turn)], -scatter[(rate, turn)]);
    let normal = Matrix2::new(xx, xt, xt, tt);
    if damping && normal.determinant() > COLLINEAR * xx * tt {
        let right = Vector2::new(xy, yt);
        let solved = normal.try_inverse()? * right;
        let unexplained = (yy - right.dot(&solved)).max(0.0);
        let excitation = (xx - xt * xt / tt).max(0.0);
        return Some(Axis { coefficient: solved.x, damping: solved.y, unexplained, excitation });
    }
    let coefficient = xy / xx;
    Some(Axis { coefficient, damping: 0.0, unexplained: (yy - coefficient * xy).max(0.0), excitation: xx })
}
