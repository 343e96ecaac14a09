//! Reductions of vectors of a few components, and a product with a matrix, as plain loops.
//!
//! nalgebra's versions use iterators and functions that are not marked inline. From another codegen unit they compile
//! to calls, and a step of the identifier took three times the instructions. The results must be bit-identical to
//! nalgebra's.

use nalgebra::{SMatrix, SVector};

/// Returns the zero vector.
#[inline]
pub fn zeros<const N: usize>() -> SVector<f64, N> {
    SVector::from([0.0; N])
}

/// Returns the largest magnitude of a component.
#[inline]
pub fn amax<const N: usize>(v: &SVector<f64, N>) -> f64 {
    let mut largest = v[0].abs();
    for index in 1..N {
        largest = if largest >= v[index].abs() { largest } else { v[index].abs() };
    }
    largest
}

/// Returns the sum of the components.
#[inline]
pub fn sum<const N: usize>(v: &SVector<f64, N>) -> f64 {
    reduce(v, 0.0, |sum, x| sum + x)
}

/// Returns the product of the components.
#[inline]
pub fn product<const N: usize>(v: &SVector<f64, N>) -> f64 {
    reduce(v, 1.0, |product, x| product * x)
}

/// Returns `a`·`v`, summed column by column.
#[inline]
pub fn times<const N: usize>(a: &SMatrix<f64, N, N>, v: &SVector<f64, N>) -> SVector<f64, N> {
    let mut sum = zeros();
    for row in 0..N {
        sum[row] = a[(row, 0)] * v[0];
        for column in 1..N {
            sum[row] += a[(row, column)] * v[column];
        }
    }
    sum
}

#[inline]
fn reduce<const N: usize>(v: &SVector<f64, N>, start: f64, f: impl Fn(f64, f64) -> f64) -> f64 {
    let mut value = start;
    for index in 0..N {
        value = f(value, v[index]);
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Vector3};

    #[test]
    fn results_are_bit_identical_to_nalgebra() {
        // Rust does not specify the bits of a NaN.
        let bits = |values: [f64; 3]| values.map(|value| if value.is_nan() { 1 } else { value.to_bits() });
        let values = [0.1, -0.0, 1e-300, -3.7e5, f64::INFINITY, f64::NAN];
        for picked in 0..values.len().pow(3) {
            let v = Vector3::from([picked, picked / 6, picked / 36].map(|index| values[index % 6]));
            assert_eq!(bits([amax(&v), sum(&v), product(&v)]), bits([v.amax(), v.sum(), v.product()]), "{v}");
            let a = Matrix3::new(v.x, v.y, 0.3, v.z, 0.7, v.y, -1.1, v.z, v.x);
            assert_eq!(bits(times(&a, &v).into()), bits((a * v).into()), "{a} {v}");
        }
    }
}
