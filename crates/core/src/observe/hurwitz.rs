//! A checked decay matrix for the identifier: every eigenvalue has a negative real part, \[SZ\](7)-(9).
//!
//! It must not accept a matrix under which an error would stay or grow, nor allocate. The exponential is implemented
//! here because nalgebra's needs `std`: scaling, a Taylor polynomial, squaring. It needs no eigenvectors, so a
//! defective matrix is no special case.

use crate::vector::times;
use core::fmt;
use nalgebra::allocator::Allocator;
use nalgebra::{Complex, Const, DefaultAllocator, DimDiff, DimSub, SMatrix, SVector, Schur, U1};

/// The accuracy of the eigenvalues relative to the matrix' Frobenius norm; an eigenvalue nearer to the imaginary axis
/// may lie on it.
const EIGENVALUE_TOLERANCE: f64 = 64.0 * f64::EPSILON;

/// The bound on QR sweeps. A few per eigenvalue suffice; the bound guarantees that the constructor ends.
const MAX_SWEEPS: usize = 1000;

/// The largest norm for the Taylor polynomial, at which its remainder is below a rounding: ½^15/15! = 2e-17.
const TAYLOR_NORM: f64 = 0.5;

/// The degree of the Taylor polynomial.
const TAYLOR_DEGREE: u32 = 14;

/// The largest norm for the short polynomial, at which its remainder is below a rounding: (1/64)⁷/7! = 5e-17.
const SHORT_NORM: f64 = 1.0 / 64.0;

/// 1/k for k from 6 down to 1.
const SHORT_INVERSES: [f64; 6] = [1.0 / 6.0, 1.0 / 5.0, 1.0 / 4.0, 1.0 / 3.0, 1.0 / 2.0, 1.0];

/// The exponent of the slowest mode at which all of e^{𝒜W} is below the smallest double, however far from normal 𝒜
/// is: with the tolerance above, the accompanying powers of W stay below 1e200 up to N = 10.
const VANISHED: f64 = 1200.0;

/// The N eigenvalues of a real matrix, printed as a list with four significant digits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Eigenvalues<const N: usize>(pub SVector<Complex<f64>, N>);

impl<const N: usize> fmt::Display for Eigenvalues<N> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, value) in self.0.iter().enumerate() {
            formatter.write_str(if index == 0 { "" } else { ", " })?;
            match value.im {
                0.0 => write_rounded(formatter, value.re, false)?,
                im => {
                    write_rounded(formatter, value.re, false)?;
                    write_rounded(formatter, im, true)?;
                    formatter.write_str("i")?;
                }
            }
        }
        Ok(())
    }
}

/// Writes a number with four significant digits, and with its sign if `signed`.
fn write_rounded(formatter: &mut fmt::Formatter<'_>, value: f64, signed: bool) -> fmt::Result {
    let magnitude = libm::floor(libm::log10(value.abs()));
    match (value != 0.0 && !(-4.0..4.0).contains(&magnitude), signed) {
        (true, false) => write!(formatter, "{value:.3e}"),
        (true, true) => write!(formatter, "{value:+.3e}"),
        (false, _) => {
            let decimals = if value == 0.0 { 0 } else { (3.0 - magnitude) as usize };
            if signed { write!(formatter, "{value:+.decimals$}") } else { write!(formatter, "{value:.decimals$}") }
        }
    }
}

/// The reason why a matrix is not a decay matrix.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum HurwitzError<const N: usize> {
    /// An element is infinite or not a number.
    #[error("element ({row}, {column}) of the decay matrix is {value}; every element must be a finite number")]
    NotFinite {
        /// Row, counted from 1.
        row: usize,
        /// Column, counted from 1.
        column: usize,
        /// The element as given.
        value: f64,
    },
    /// An error would stay or grow along some direction.
    #[error(
        "the decay matrix has the eigenvalues {eigenvalues}; all of them must have a negative real part (by more than \
         {tolerance:.1e}, to which they are known), or the estimate does not converge"
    )]
    NotHurwitz {
        /// All eigenvalues.
        eigenvalues: Eigenvalues<N>,
        /// The accuracy of the eigenvalues; zero for a diagonal matrix.
        tolerance: f64,
    },
    /// The eigenvalues could not be computed.
    #[error(
        "the eigenvalues of the decay matrix could not be computed in {} sweeps; choose other elements",
        MAX_SWEEPS
    )]
    NoEigenvalues,
}

impl<const N: usize> From<&HurwitzError<N>> for &'static str {
    /// Returns the stable name of the error.
    fn from(error: &HurwitzError<N>) -> Self {
        match error {
            HurwitzError::NotFinite { .. } => "not-finite",
            HurwitzError::NotHurwitz { .. } => "not-hurwitz",
            HurwitzError::NoEigenvalues => "no-eigenvalues",
        }
    }
}

/// A real N×N matrix 𝒜 whose eigenvalues all have a negative real part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hurwitz<const N: usize> {
    matrix: SMatrix<f64, N, N>,
    eigenvalues: Eigenvalues<N>,
    /// The greatest real part of an eigenvalue.
    abscissa: f64,
    /// ‖𝒜‖₁.
    norm: f64,
    diagonal: bool,
}

impl<const N: usize> Hurwitz<N> {
    /// Checks a decay matrix. Its unit is one over that of the relation's weight, 1/s where ρ = 1.
    ///
    /// A diagonal matrix is checked exactly. Otherwise an eigenvalue whose real part is negative by no more than the
    /// accuracy of the computation is rejected too. Multiple eigenvalues are known to few digits only.
    ///
    /// # Errors
    /// [`HurwitzError`] contains the element that is not finite, or all eigenvalues.
    pub fn new(matrix: SMatrix<f64, N, N>) -> Result<Self, HurwitzError<N>>
    where
        Const<N>: DimSub<U1>,
        DefaultAllocator: Allocator<Const<N>, DimDiff<Const<N>, U1>> + Allocator<DimDiff<Const<N>, U1>>,
    {
        for (index, &value) in matrix.iter().enumerate() {
            if !value.is_finite() {
                return Err(HurwitzError::NotFinite { row: index % N + 1, column: index / N + 1, value });
            }
        }
        let diagonal = matrix == SMatrix::from_diagonal(&matrix.diagonal());
        let (eigenvalues, tolerance) = if diagonal {
            (matrix.diagonal().map(|value| Complex::new(value, 0.0)), 0.0)
        } else {
            // Scaled, because the squares in norms and discriminants of extreme matrices exceed the range of a
            // double.
            let scale = matrix.amax();
            let scaled = matrix / scale;
            let schur = Schur::try_new(scaled, f64::EPSILON, MAX_SWEEPS).ok_or(HurwitzError::NoEigenvalues)?;
            (schur.complex_eigenvalues().map(|value| value * scale), EIGENVALUE_TOLERANCE * scaled.norm() * scale)
        };
        let abscissa = eigenvalues.iter().map(|value| value.re).fold(f64::NEG_INFINITY, f64::max);
        let eigenvalues = Eigenvalues(eigenvalues);
        if eigenvalues.0.iter().all(|value| value.re < -tolerance) {
            Ok(Self { matrix, eigenvalues, abscissa, norm: norm(&matrix), diagonal })
        } else {
            Err(HurwitzError::NotHurwitz { eigenvalues, tolerance })
        }
    }

    /// Returns the matrix 𝒜.
    pub fn matrix(&self) -> &SMatrix<f64, N, N> {
        &self.matrix
    }

    /// Returns the eigenvalues in no particular order; multiple ones are known to few digits unless 𝒜 is diagonal.
    pub fn eigenvalues(&self) -> &Eigenvalues<N> {
        &self.eigenvalues
    }

    /// Returns the largest real part of an eigenvalue, negative: the exponent of the slowest decay.
    pub fn abscissa(&self) -> f64 {
        self.abscissa
    }

    /// Returns the diagonal if the matrix is diagonal, which is the paper's final form, \[SZ\](10).
    pub fn diagonal(&self) -> Option<SVector<f64, N>> {
        self.diagonal.then(|| self.matrix.diagonal())
    }

    /// Computes e^{𝒜W}·`error` for a finite `weight` W ≥ 0; for the short steps of a loop by a series on the vector
    /// alone.
    #[inline]
    pub fn decayed(&self, weight: f64, error: &SVector<f64, N>) -> SVector<f64, N> {
        if self.norm * weight > SHORT_NORM {
            return self.exp(weight) * error;
        }
        SHORT_INVERSES.iter().fold(*error, |sum, inverse| error + times(&self.matrix, &sum) * (weight * inverse))
    }

    /// Computes e^{𝒜W} for a finite `weight` W ≥ 0; the identity for 0.
    ///
    /// Exact to rounding for a diagonal matrix. Otherwise the error is that of rounding the elements of 𝒜: relative
    /// to the norm about ε·‖𝒜‖W, more if 𝒜 is far from normal. Values below the smallest double are zero.
    pub fn exp(&self, weight: f64) -> SMatrix<f64, N, N> {
        if self.diagonal {
            SMatrix::from_diagonal(&self.matrix.diagonal().map(|value| libm::exp(value * weight)))
        } else if self.abscissa * weight < -VANISHED {
            SMatrix::zeros()
        } else {
            exponential(self.matrix * weight)
        }
    }
}

/// Returns ‖X‖₁, the largest absolute column sum.
fn norm<const N: usize>(x: &SMatrix<f64, N, N>) -> f64 {
    x.column_iter().map(|column| column.iter().map(|value| value.abs()).sum()).fold(0.0, f64::max)
}

/// Computes e^X by scaling and squaring. The caller bounds ‖X‖: otherwise the loop would lose all digits.
fn exponential<const N: usize>(x: SMatrix<f64, N, N>) -> SMatrix<f64, N, N> {
    let (mut scaled, mut norm, mut squarings) = (x, norm(&x), 0_u32);
    while norm > TAYLOR_NORM {
        // Halving is exact.
        (scaled, norm, squarings) = (scaled * 0.5, norm * 0.5, squarings + 1);
    }
    let mut power = SMatrix::identity();
    for degree in (1..=TAYLOR_DEGREE).rev() {
        power = SMatrix::identity() + scaled * power / f64::from(degree);
    }
    for _ in 0..squarings {
        power *= power;
    }
    power
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix1, Matrix2, Matrix3};

    /// Returns the largest difference of two matrices; infinite for a NaN.
    fn distance<const N: usize>(left: &SMatrix<f64, N, N>, right: &SMatrix<f64, N, N>) -> f64 {
        (left - right).iter().map(|d| if d.is_nan() { f64::INFINITY } else { d.abs() }).fold(0.0, f64::max)
    }

    /// Rotates a matrix by no special angles: the eigenvalues stay, and no element is zero.
    fn turned(matrix: Matrix3<f64>) -> Matrix3<f64> {
        let turn = nalgebra::Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
        turn * matrix * turn.transpose()
    }

    #[test]
    fn the_short_series_is_within_two_roundings_of_the_exponential() {
        let matrices = [
            Matrix3::new(-6.0, 1.0, -2.0, 0.5, -4.0, 1.0, 2.0, 0.0, -5.0),
            turned(Matrix3::from_diagonal(&nalgebra::Vector3::new(-1.0, -3.0, -200.0))),
            turned(jordan(1.0, -2.0)[0]),
        ];
        let errors = [nalgebra::Vector3::new(0.3, -1.0, 0.7), nalgebra::Vector3::new(1e-9, 1.0, -1e-3)];
        for (matrix, error) in matrices.iter().flat_map(|matrix| errors.iter().map(move |error| (matrix, error))) {
            let hurwitz = Hurwitz::new(*matrix).unwrap();
            for part in (0..=200).map(|n| f64::from(n) / 200.0) {
                let weight = SHORT_NORM * part / hurwitz.norm;
                let (short, exact) = (hurwitz.decayed(weight, error), hurwitz.exp(weight) * error);
                assert!((short - exact).amax() <= 4.0 * f64::EPSILON * error.amax(), "{matrix} {weight}");
            }
            let long = 2.0 * SHORT_NORM / hurwitz.norm;
            assert_eq!(hurwitz.decayed(long, error), hurwitz.exp(long) * error);
        }
    }

    /// e^{λt} (1, t, t²/2; 0, 1, t; 0, 0, 1).
    fn jordan(t: f64, lambda: f64) -> [Matrix3<f64>; 2] {
        let block = Matrix3::new(lambda, 1.0, 0.0, 0.0, lambda, 1.0, 0.0, 0.0, lambda);
        let power = Matrix3::new(1.0, t, t * t / 2.0, 0.0, 1.0, t, 0.0, 0.0, 1.0) * (lambda * t).exp();
        [block, power]
    }

    #[test]
    fn a_matrix_without_decay_is_refused_with_its_eigenvalues() {
        let rotation = turned(Matrix3::new(0.0, 2.0, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0, -1.0));
        let growing = turned(Matrix3::new(-1.0, 5.0, 1.0, 0.0, 0.5, 2.0, 0.0, 0.0, -3.0));
        let nilpotent = turned(jordan(0.0, 0.0)[0]);
        let still = Matrix3::from_diagonal(&nalgebra::Vector3::new(-1.0, 0.0, -1.0));
        for matrix in [rotation, growing, nilpotent, still, Matrix3::zeros()] {
            let refusal = Hurwitz::new(matrix).unwrap_err();
            assert!(matches!(refusal, HurwitzError::NotHurwitz { .. }), "{matrix}: {refusal}");
        }
        let message = format!("{}", Hurwitz::new(Matrix2::new(1.0, 2.0, -2.0, 1.0)).unwrap_err());
        assert!(message.contains("1.000+2.000i, 1.000-2.000i"), "{message}");
        let message = format!("{}", Hurwitz::new(still).unwrap_err());
        assert!(message.contains("-1.000, 0, -1.000;"), "{message}");
    }

    #[test]
    fn an_element_that_is_not_finite_is_refused() {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let mut matrix = -Matrix3::identity();
            matrix[(0, 2)] = value;
            let refusal = Hurwitz::new(matrix).unwrap_err();
            assert!(matches!(refusal, HurwitzError::NotFinite { row: 1, column: 3, .. }), "{refusal}");
        }
    }

    #[test]
    fn the_eigenvalues_are_accurate() {
        let spiral = Hurwitz::new(turned(Matrix3::new(-1.0, 2.0, 0.0, -2.0, -1.0, 0.0, 0.0, 0.0, -0.25))).unwrap();
        let mut found: Vec<_> = spiral.eigenvalues().0.iter().map(|value| (value.re, value.im)).collect();
        found.sort_by(|left, right| left.partial_cmp(right).unwrap());
        for (found, expected) in found.iter().zip([(-1.0, -2.0), (-1.0, 2.0), (-0.25, 0.0)]) {
            assert!((found.0 - expected.0).hypot(found.1 - expected.1) < 1e-14, "{found:?}");
        }
        assert!((spiral.abscissa() + 0.25).abs() < 1e-14);
        assert_eq!(Hurwitz::new(Matrix1::new(-3.0)).unwrap().abscissa(), -3.0);
    }

    #[test]
    fn the_exponential_of_a_diagonal_matrix_is_exact() {
        let rates = nalgebra::Vector3::new(-1e-3, -5.0, -1e6);
        let hurwitz = Hurwitz::new(Matrix3::from_diagonal(&rates)).unwrap();
        assert_eq!(hurwitz.diagonal(), Some(rates));
        for weight in [0.0, 1e-9, 0.3, 40.0, 1e300] {
            let expected = rates.map(|rate| libm::exp(rate * weight));
            assert_eq!(hurwitz.exp(weight), Matrix3::from_diagonal(&expected));
        }
    }

    #[test]
    fn the_exponential_of_defective_and_rotating_matrices_is_accurate() {
        for weight in [0.0, 1e-6, 0.02, 0.7, 5.0, 60.0] {
            let [block, power] = jordan(weight, -1.5);
            let spiral = Matrix3::new(-1.0, 2.0, 0.0, -2.0, -1.0, 0.0, 0.0, 0.0, -0.25);
            let (sin, cos) = (2.0 * weight).sin_cos();
            let spun = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, (0.75 * weight).exp()) * (-weight).exp();
            for (matrix, power) in [(block, power), (turned(block), turned(power)), (turned(spiral), turned(spun))] {
                let error = distance(&Hurwitz::new(matrix).unwrap().exp(weight), &power) / power.norm();
                // The cube is the block's own sensitivity: a disturbance grows with t² before and after it enters.
                assert!(error < 1e-15 * (2.0 + 4.0 * weight + weight.powi(3)), "weight {weight}: {error:e}");
            }
        }
    }

    #[test]
    fn the_exponential_vanishes_after_long_steps() {
        let matrix = turned(Matrix3::new(-1e-3, 1e9, 0.0, 0.0, -2.0, 1e6, 0.0, 0.0, -1e4));
        let hurwitz = Hurwitz::new(matrix).unwrap();
        assert!(hurwitz.exp(1e5).iter().all(|value| value.is_finite()));
        for weight in [2e6, 1e12, 1e300, f64::MAX] {
            assert_eq!(hurwitz.exp(weight), Matrix3::zeros());
        }
        assert_eq!(hurwitz.exp(0.0), Matrix3::identity());
    }
}
