//! The whole inertia tensor, up to its scale, for a sensor at any orientation to the body.
//!
//! In the sensor's axes J ω(t) + ∫ω × Jω dt is constant without torque, and J ω + ∫(ω × Jω + c Jω) dt under a damping
//! torque −c Jω: both are linear in the six entries of J. The deviation from that constant is J times a residual in
//! rad/s, so the squares are weighted by J⁻² of the last round. Noise of equal size on all rates contributes tr(J J⁻²
//! J), the reference of the sum. So the smallest of six generalised eigenvalues is computed repeatedly: total least
//! squares, which noise does not bias towards a sphere. The fit must not depend on a given noise or alignment.
//!
//! A wheel of momentum h adds (∫ω dt) × h. It has no noise of its own, so its share, the inverse of the scale of J, is
//! eliminated like a mean.

use super::motion::{FEATURES, Motion, PRODUCTS, SWEEPS, Sums, TURNS};
use super::spread;
use nalgebra::{Cholesky, Matrix3, Matrix6, SMatrix, SVector, SymmetricEigen, Vector3, Vector6};

/// The maximum number of rounds of weighting, and the change of J at which they end.
const ROUNDS: usize = 40;
const SETTLED: f64 = 1e-9;
/// The smallest moment used in a weight, as a part of the largest.
const LEAST_MOMENT: f64 = 1e-3;

/// A linear map from the features to the conserved vector.
type Row = SMatrix<f64, 3, FEATURES>;

/// The maps of all six elements of a tensor, stacked.
type Stack = SMatrix<f64, 18, FEATURES>;

/// The result of least squares for a body's inertia tensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TensorFit {
    /// The principal moments, the largest being 1, each of the axis closest to the sensor's x, y or z. They may be
    /// negative if the model is wrong.
    pub moments: Vector3<f64>,
    /// The standard deviations of the moments, by resampling; absent if there are too few pieces.
    pub deviation: Option<Vector3<f64>>,
    /// The principal axes as columns, in the sensor's axes: a rotation. Its transpose converts a measured rate to
    /// these axes.
    pub axes: Matrix3<f64>,
    /// The standard deviation of the direction of each axis, by resampling, rad.
    pub axes_deviation_rad: Option<Vector3<f64>>,
    /// The damping by a torque −c Jω, 1/s; zero unless it is fitted.
    pub damping_per_s: f64,
    /// The standard deviation of the damping, by resampling.
    pub damping_deviation_per_s: Option<f64>,
    /// The part of each measured rate's variance about its mean that the motion explains, at most 1.
    pub r_squared: Vector3<f64>,
    /// The ratio of the two smallest eigenvalues: how much worse the next tensor fits. Near 1 the motion does not
    /// determine the tensor.
    pub distinction: f64,
    /// The largest moment with its standard deviation by resampling, if a wheel gives the scale: kg m² for N m s. It is negative
    /// if the motion shows a wheel that turns the other way.
    pub largest: Option<(f64, Option<f64>)>,
}

impl TensorFit {
    /// Returns the angle of each principal axis from the sensor's, rad.
    pub fn tilt_rad(&self) -> Vector3<f64> {
        self.axes.diagonal().map(|cosine| libm::acos(cosine.abs().min(1.0)))
    }
}

/// A tensor during the iteration.
#[derive(Debug, Clone, Copy)]
pub(super) struct Solution {
    /// The tensor, of trace 1.
    pub tensor: Matrix3<f64>,
    damping: f64,
    /// The factor of the wheel's momentum.
    wheel: f64,
    distinction: f64,
}

impl Motion {
    /// Fits the whole tensor; with `damping`, the air's torque too.
    ///
    /// Returns `None` if the motion has no piece, or does not determine a tensor.
    pub fn about_unknown_axes(&self, damping: bool) -> Option<TensorFit> {
        self.tensor(true, damping)
    }

    /// Fits the moments about the sensor's own axes, the largest being 1: the fit of
    /// [`about_unknown_axes`](Self::about_unknown_axes) with a diagonal tensor.
    pub fn moments_about_known_axes(&self, damping: bool) -> Option<TensorFit> {
        self.tensor(false, damping)
    }

    fn tensor(&self, whole: bool, damping: bool) -> Option<TensorFit> {
        let total = self.total();
        let best = solve(&total, whole, damping)?;
        let (moments, axes) = principal(&best.tensor)?;
        // The moments, then the directions by their part across the axis, then the damping, then the inverse of the largest moment.
        let spread = spread::over_groups(self, |sums| {
            let solution = solve(sums, whole, damping)?;
            let (moments, own) = principal(&solution.tensor)?;
            let across = axes.transpose() * own;
            Some(SVector::<f64, 11>::from_fn(|row, _| match row {
                0..3 => moments[row],
                3..9 => {
                    let column = (row - 3) / 2;
                    across[((column + 1 + row % 2) % 3, column)]
                }
                9 => solution.damping,
                _ => moments.sum() * solution.wheel,
            }))
        });
        let direction = |spread: &SVector<f64, 11>| {
            Vector3::from_fn(|column, _| {
                let (first, second) = (spread[3 + 2 * column], spread[4 + 2 * column]);
                libm::sqrt(first * first + second * second)
            })
        };
        let largest = 1.0 / (moments.sum() * best.wheel);
        let largest = (largest, spread.map(|spread| spread[10] * largest * largest));
        Some(TensorFit {
            moments,
            deviation: spread.map(|spread| spread.fixed_rows::<3>(0).into_owned()),
            axes,
            axes_deviation_rad: spread.as_ref().map(direction),
            damping_per_s: best.damping,
            damping_deviation_per_s: spread.map(|spread| spread[9]),
            r_squared: r_squared(&total, &best)?,
            distinction: best.distinction,
            largest: self.has_wheel().then_some(largest),
        })
    }
}

#[cfg(feature = "std")]
impl Sums {
    /// Fits a tensor, the whole one or about the sensor's axes, to the motion of rates times `scale`. Returns the unexplained part
    /// of the variance of all rates; `None` if no body has the tensor.
    pub fn unexplained(mut self, whole: bool, scale: f64) -> Option<f64> {
        for product in PRODUCTS..TURNS {
            self.scatter.row_mut(product).scale_mut(scale);
            self.scatter.column_mut(product).scale_mut(scale);
        }
        let best = solve(&self, whole, true)?;
        super::nearest_body(&principal(&best.tensor)?.0).ok()?;
        let whole = self.scatter.diagonal().fixed_rows::<3>(0).into_owned();
        let part = r_squared(&self, &best)?.map(|explained| 1.0 - explained);
        Some(part.dot(&whole) / whole.sum())
    }
}

/// Returns an element of the basis of symmetric tensors, of unit length: xx, yy, zz, yz, zx, xy.
fn basis(index: usize) -> Matrix3<f64> {
    let mut tensor = Matrix3::zeros();
    if index < 3 {
        tensor[(index, index)] = 1.0;
    } else {
        let (row, column) = ((index - 2) % 3, (index - 1) % 3);
        tensor[(row, column)] = core::f64::consts::FRAC_1_SQRT_2;
        tensor[(column, row)] = core::f64::consts::FRAC_1_SQRT_2;
    }
    tensor
}

/// Returns the index of the product of two rates among the features.
fn product(first: usize, second: usize) -> usize {
    if first == second { PRODUCTS + first } else { PRODUCTS + 3 + (3 - first - second) }
}

/// Returns J ω + ∫ω × Jω, and ∫Jω, as maps of the features.
fn maps(tensor: &Matrix3<f64>) -> [Row; 2] {
    let (mut free, mut damped) = (Row::zeros(), Row::zeros());
    for row in 0..3 {
        for column in 0..3 {
            free[(row, column)] = tensor[(row, column)];
            damped[(row, TURNS + column)] = tensor[(row, column)];
        }
        // (ω × Jω)_row = ω_next (Jω)_last − ω_last (Jω)_next.
        let (next, last) = ((row + 1) % 3, (row + 2) % 3);
        for column in 0..3 {
            free[(row, product(next, column))] += tensor[(last, column)];
            free[(row, product(last, column))] -= tensor[(next, column)];
        }
    }
    [free, damped]
}

/// Returns ∫ω dt × h as a map of the features.
fn wheel_map(momentum: &Vector3<f64>) -> Row {
    let mut map = Row::zeros();
    map.fixed_columns_mut::<3>(TURNS).copy_from(&-momentum.cross_matrix());
    map
}

pub(super) fn solve(sums: &Sums, whole: bool, with_damping: bool) -> Option<Solution> {
    let mut scatter = sums.scatter;
    scatter.fill_lower_triangle_with_upper_triangle();
    let largest = scatter.diagonal().max();
    if !(sums.samples > 0 && largest > 0.0 && scatter.iter().all(|entry| entry.is_finite())) {
        return None;
    }
    let unknowns = if whole { 6 } else { 3 };
    let elements = [0, 1, 2, 3, 4, 5].map(basis);
    let (mut free, mut damped) = (Stack::zeros(), Stack::zeros());
    for (index, element) in elements.iter().enumerate() {
        let [free_map, damped_map] = maps(element);
        free.fixed_rows_mut::<3>(3 * index).copy_from(&free_map);
        damped.fixed_rows_mut::<3>(3 * index).copy_from(&damped_map);
    }
    // All products of the scatter that a round needs.
    let products =
        [free * scatter * free.transpose(), free * scatter * damped.transpose(), damped * scatter * damped.transpose()];
    let wheel = wheel_map(&sums.wheel);
    let wheel_products = [free, damped].map(|maps| maps * scatter * wheel.transpose());
    let wheel_square = wheel * scatter * wheel.transpose();
    // The sum of weight · block over the block of two elements.
    let weighed = |product: &SMatrix<f64, 18, 18>, weight: &Matrix3<f64>, p: usize, q: usize| {
        product.fixed_view::<3, 3>(3 * p, 3 * q).dot(weight)
    };
    let mut solution = Solution { tensor: Matrix3::identity() / 3.0, damping: 0.0, wheel: 0.0, distinction: 0.0 };
    for _ in 0..ROUNDS {
        let (weight, c) = (weight(&solution.tensor)?, solution.damping);
        let (mut left, mut right) = (Matrix6::zeros(), Matrix6::zeros());
        let square = wheel_square.dot(&weight);
        let per_square = |value: f64| if square > 0.0 { value / square } else { 0.0 };
        let beside = |p: usize| wheel_products.map(|product| product.fixed_view::<3, 3>(3 * p, 0).dot(&weight));
        let beside = [0, 1, 2, 3, 4, 5].map(beside);
        let eliminated = beside.map(|[free, damped]| free + c * damped);
        for p in 0..unknowns {
            for q in 0..unknowns {
                let [free, first, damped] = [0, 1, 2].map(|kind| weighed(&products[kind], &weight, p, q));
                let second = weighed(&products[1], &weight, q, p);
                left[(p, q)] = free + c * (first + second) + c * c * damped - per_square(eliminated[p] * eliminated[q]);
                right[(p, q)] = (elements[p] * weight).dot(&elements[q]);
            }
        }
        // Unused unknowns are decoupled, with an eigenvalue among those of the others.
        let apart = (left.trace(), right.trace());
        for p in unknowns..6 {
            (left[(p, p)], right[(p, p)]) = apart;
        }
        let (found, distinction) = smallest(&left, &right, unknowns)?;
        let tensor = (0..6).fold(Matrix3::zeros(), |sum, index| sum + elements[index] * found[index]);
        let trace = tensor.trace();
        if trace == 0.0 || !trace.is_finite() {
            return None;
        }
        let (tensor, found) = (tensor / trace, found / trace);
        let change = (tensor - solution.tensor).amax();
        let [free_wheel, damped_wheel] = [0, 1].map(|kind| (0..6).map(|p| found[p] * beside[p][kind]).sum::<f64>());
        let (mut damping, mut wheel) = (0.0, -per_square(free_wheel));
        if with_damping {
            let sum = |kind: usize| {
                let terms = (0..36).map(|pair| (pair / 6, pair % 6));
                terms.map(|(p, q)| found[p] * found[q] * weighed(&products[kind], &weight, p, q)).sum::<f64>()
            };
            let apart = sum(2) - per_square(damped_wheel * damped_wheel);
            damping = if apart > 0.0 { -(sum(1) + wheel * damped_wheel) / apart } else { 0.0 };
            wheel -= damping * per_square(damped_wheel);
        }
        solution = Solution { tensor, damping, wheel, distinction };
        if change < SETTLED && (damping - c).abs() <= SETTLED * (1.0 + c.abs()) {
            break;
        }
    }
    Some(solution)
}

/// Returns J⁻², with a lower limit on the moments: the weight of the residuals.
fn weight(tensor: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::try_new(*tensor, f64::EPSILON, SWEEPS)?;
    let least = LEAST_MOMENT * eigenvalues.amax();
    let inverse = eigenvalues.map(|moment| 1.0 / (moment.max(least) * moment.max(least)));
    let weight = eigenvectors * Matrix3::from_diagonal(&inverse) * eigenvectors.transpose();
    let weight = weight / weight.trace();
    weight.iter().all(|entry| entry.is_finite()).then_some(weight)
}

/// Returns the x with the smallest ratio of x·left·x to x·right·x, and the ratio of the next smallest to it, over
/// vectors whose entries after the first `unknowns` are zero.
fn smallest(left: &Matrix6<f64>, right: &Matrix6<f64>, unknowns: usize) -> Option<(Vector6<f64>, f64)> {
    let lower = Cholesky::new(*right)?.unpack();
    let inverse = lower.solve_lower_triangular(&Matrix6::identity())?;
    let scaled = inverse * left * inverse.transpose();
    let scaled = (scaled + scaled.transpose()) * 0.5;
    if !scaled.iter().all(|entry| entry.is_finite()) {
        return None;
    }
    let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::try_new(scaled, f64::EPSILON, SWEEPS)?;
    let wanted = |index: usize| eigenvectors.column(index).iter().take(unknowns).map(|x| x * x).sum::<f64>() > 0.5;
    let smaller = |least: (usize, f64), index: usize| {
        if eigenvalues[index] < least.1 { (index, eigenvalues[index]) } else { least }
    };
    let (best, least) = (0..6).filter(|index| wanted(*index)).fold((0, f64::INFINITY), smaller);
    let (_, next) = (0..6).filter(|index| wanted(*index) && *index != best).fold((0, f64::INFINITY), smaller);
    // Rounding may make a zero eigenvalue negative.
    let floor = f64::EPSILON * eigenvalues.amax();
    let distinction = next.max(floor) / least.max(floor);
    Some((inverse.transpose() * eigenvectors.column(best), distinction))
}

/// Returns the principal moments, the largest 1, and the axes, each the one closest to a sensor's axis.
pub(super) fn principal(tensor: &Matrix3<f64>) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::try_new(*tensor, f64::EPSILON, SWEEPS)?;
    const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    let aligned = |order: &[usize; 3]| (0..3).map(|axis| eigenvectors[(axis, order[axis])].abs()).sum::<f64>();
    let order = ORDERS.into_iter().max_by(|first, second| aligned(first).total_cmp(&aligned(second)))?;
    let mut axes = Matrix3::from_fn(|row, column| eigenvectors[(row, order[column])]);
    for column in 0..3 {
        if axes[(column, column)] < 0.0 {
            axes.column_mut(column).neg_mut();
        }
    }
    if axes.determinant() < 0.0 {
        // The axes must form a rotation: the least aligned axis is reversed if necessary.
        let column = axes.diagonal().map(f64::abs).imin();
        axes.column_mut(column).neg_mut();
    }
    let moments = Vector3::from_fn(|axis, _| eigenvalues[order[axis]]);
    let largest = moments.max();
    (largest > 0.0).then(|| (moments / largest, axes))
}

/// Returns the sums of the squares of each rate that the body does not explain.
pub(super) fn left(sums: &Sums, solution: &Solution) -> Option<Vector3<f64>> {
    let mut scatter = sums.scatter;
    scatter.fill_lower_triangle_with_upper_triangle();
    let [free, damped] = maps(&solution.tensor);
    let whole = free + damped * solution.damping + wheel_map(&sums.wheel) * solution.wheel;
    let left = solution.tensor.try_inverse()? * whole;
    Some((left * scatter * left.transpose()).diagonal())
}

/// Returns the explained part of each rate's variance.
fn r_squared(sums: &Sums, solution: &Solution) -> Option<Vector3<f64>> {
    let (scatter, unexplained) = (&sums.scatter, left(sums, solution)?);
    Some(Vector3::from_fn(|axis, _| {
        let whole = scatter[(axis, axis)];
        if whole > 0.0 { 1.0 - unexplained[axis] / whole } else { 0.0 }
    }))
}
