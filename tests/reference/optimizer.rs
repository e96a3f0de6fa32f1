//! Adam with decoupled weight decay (Loshchilov & Hutter 2019, algorithm 2); without decay it is Adam.

#[derive(Clone, Debug)]
pub struct Adam {
    pub beta1: f64,
    pub beta2: f64,
    pub epsilon: f64,
    pub weight_decay: f64,
    /// Updates so far.
    pub steps: i32,
    pub m: Vec<f64>,
    pub v: Vec<f64>,
}

impl Adam {
    pub fn new(len: usize, betas: [f64; 2], epsilon: f64, weight_decay: f64) -> Adam {
        let [beta1, beta2] = betas;
        Adam {
            beta1,
            beta2,
            epsilon,
            weight_decay,
            steps: 0,
            m: vec![0.0; len],
            v: vec![0.0; len],
        }
    }

    /// p ← p(1 − ηλ); m ← β₁m + (1 − β₁)g; v ← β₂v + (1 − β₂)g²; p ← p − η m̂/(√v̂ + ε) with the bias-corrected moments. Entries of
    /// zero gradient decay and move on by their moments.
    pub fn update(&mut self, params: &mut [f64], gradients: &[f64], learning_rate: f64) {
        self.steps += 1;
        let correction1 = 1.0 - self.beta1.powi(self.steps);
        let correction2 = 1.0 - self.beta2.powi(self.steps);
        for (i, (p, g)) in params.iter_mut().zip(gradients).enumerate() {
            *p *= 1.0 - learning_rate * self.weight_decay;
            self.m[i] = self.beta1 * self.m[i] + (1.0 - self.beta1) * g;
            self.v[i] = self.beta2 * self.v[i] + (1.0 - self.beta2) * g * g;
            *p -= learning_rate * (self.m[i] / correction1)
                / ((self.v[i] / correction2).sqrt() + self.epsilon);
        }
    }
}
