//! The textbook's extended Kalman filter of a free body's three rates, two of them measured: the reference of this
//! project's filters. Not part of the library.

use corotate::model::{euler, rk4_step};
use nalgebra::{Matrix3, Vector3};

/// An extended Kalman filter linearised about its own estimate, as in the textbook, so that it may diverge.
pub struct Ekf {
    coefficients: Vector3<f64>,
    axis: usize,
    /// Variance of a measured component, (rad/s)².
    sensor_variance: f64,
    /// Density of the white noise that drives the hidden component, (rad/s)²/s.
    density: f64,
    /// The estimate of the angular velocity, rad/s.
    pub state: Vector3<f64>,
    /// The covariance of the estimate, (rad/s)².
    pub covariance: Matrix3<f64>,
}

impl Ekf {
    /// Creates a filter at the first measurement with the guess in place of the hidden component `axis` (1 to 3).
    pub fn new(
        coefficients: &Vector3<f64>,
        axis: usize,
        [sensor_deviation, density]: [f64; 2],
        first: &Vector3<f64>,
        [guess, deviation]: [f64; 2],
    ) -> Self {
        let sensor_variance = sensor_deviation * sensor_deviation;
        let (mut state, mut covariance) = (*first, Matrix3::from_diagonal_element(sensor_variance));
        state[axis - 1] = guess;
        covariance[(axis - 1, axis - 1)] = deviation * deviation;
        Self { coefficients: *coefficients, axis, sensor_variance, density, state, covariance }
    }

    /// Takes a step of `h` seconds with the measurement at its end.
    pub fn step(&mut self, h: f64, measured: &Vector3<f64>) {
        let (a, x) = (self.coefficients, self.state);
        #[rustfmt::skip]
        let jacobian = Matrix3::new(
            0.0, a.x * x.z, a.x * x.y,
            a.y * x.z, 0.0, a.y * x.x,
            a.z * x.y, a.z * x.x, 0.0,
        ) * h;
        let transition = Matrix3::identity() + jacobian + jacobian * jacobian * 0.5;
        self.state = rk4_step(|x| euler(&a, x, &Vector3::zeros()), &x, h);
        self.covariance = transition * self.covariance * transition.transpose();
        self.covariance[(self.axis - 1, self.axis - 1)] += self.density * h;
        for index in (0..3).filter(|index| index + 1 != self.axis) {
            let column = self.covariance.column(index).into_owned();
            let gain = column / (column[index] + self.sensor_variance);
            self.state += gain * (measured[index] - self.state[index]);
            self.covariance -= gain * column.transpose();
        }
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
    }
}
