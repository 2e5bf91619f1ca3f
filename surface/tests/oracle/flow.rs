//! The paper's integrators on the dense grid, BasicExplicit (Alg. 1) and BasicImplicit (Alg. 2), and the
//! exact solution of implicit steps within bounds.

use super::dense::Grid;
use super::distance::LevelSet;

impl LevelSet {
    /// Laplacian smoothing: φ ← φ + 0.1 ∇²φ |∇φ| where |φ| ≤ 4, clamped.
    pub(super) fn smooth_laplacian(&mut self, step_count: usize) {
        for _ in 0..step_count {
            let old = self.phi.clone();
            for index in self.within(4.0) {
                self.phi[index] += 0.1 * self.grid.laplacian(&old, index) * self.grid.slope(&old, index);
            }
            self.clamp();
        }
    }

    /// Explicit steps: φ ← φ − Δt ∇⁴φ |∇φ| where |φ| ≤ 3, clamped.
    pub(super) fn smooth_explicit(&mut self, step_count: usize, step_size: f64, redistance_every: usize) {
        for step in 1..=step_count {
            let old = self.phi.clone();
            let free = self.within(3.0);
            let biharmonic = Biharmonic::new(&self.grid, &free).apply(&self.grid, &old);
            for (&index, biharmonic) in free.iter().zip(biharmonic) {
                self.phi[index] -= step_size * biharmonic * self.grid.slope(&old, index);
            }
            self.clamp();
            if step % redistance_every == 0 || step == step_count {
                self.redistance(f64::INFINITY);
            }
        }
    }

    /// Implicit steps: (I + Δt ∇⁴) x = φ by conjugate gradients with an active set that grows.
    pub(super) fn smooth_implicit(&mut self, step_count: usize, step_size: f64) {
        for _ in 0..step_count {
            self.conjugate_gradients(step_size, 1e-4);
            self.redistance(1.2);
        }
    }

    /// Implicit steps that find the minimum of ½|x − φ|² + ½ Δt |∇²x|² within the bounds, by accelerated
    /// projected gradients (Nesterov) with the constant momentum for a strongly convex function.
    pub(super) fn smooth_converged(&mut self, step_count: usize, step_size: f64, iterations: usize) {
        let greatest = 1.0 + 144.0 * step_size;
        let momentum = (greatest.sqrt() - 1.0) / (greatest.sqrt() + 1.0);
        for _ in 0..step_count {
            let start = self.phi.clone();
            let free = self.within(3.0);
            let mut operator = Biharmonic::new(&self.grid, &free);
            let mut ahead = start.clone();
            for _ in 0..iterations {
                for (&index, biharmonic) in free.iter().zip(operator.apply(&self.grid, &ahead)) {
                    let gradient = ahead[index] - start[index] + step_size * biharmonic;
                    let moved = (ahead[index] - gradient / greatest).max(self.lower[index]);
                    let moved = moved.min(self.upper[index]);
                    let before = std::mem::replace(&mut self.phi[index], moved);
                    ahead[index] = moved + momentum * (moved - before);
                }
            }
            self.redistance(1.2);
        }
    }

    /// One implicit step. The names of variables are those of the paper.
    fn conjugate_gradients(&mut self, step_size: f64, tolerance: f64) {
        let b = self.phi.clone();
        let mut free = self.within(3.0);
        let mut first = None;
        let mut iterations = 0;
        // Each iteration restarts with the voxels that are still free.
        'restart: loop {
            let mut operator = Biharmonic::new(&self.grid, &free);
            // r = b − A x, and d = r, on the free voxels.
            let mut r: Vec<f64> = free
                .iter()
                .zip(operator.apply(&self.grid, &self.phi))
                .map(|(&index, biharmonic)| b[index] - (self.phi[index] + step_size * biharmonic))
                .collect();
            let mut d = vec![0.0; self.grid.len()];
            free.iter().zip(&r).for_each(|(&index, r)| d[index] = *r);
            let restart = dot(&r, &r);
            let first = *first.get_or_insert(restart);
            let mut delta = restart;
            let converged = |delta: f64| delta <= tolerance * tolerance * first.max(restart);
            if first == 0.0 || (iterations > 0 && converged(delta)) {
                return;
            }
            while iterations < 1500 {
                iterations += 1;
                let q: Vec<f64> = free
                    .iter()
                    .zip(operator.apply(&self.grid, &d))
                    .map(|(&index, biharmonic)| d[index] + step_size * biharmonic)
                    .collect();
                let on_free: Vec<f64> = free.iter().map(|&index| d[index]).collect();
                let alpha = delta / dot(&on_free, &q);
                let mut held = vec![false; free.len()];
                for (k, &index) in free.iter().enumerate() {
                    let moved = self.phi[index] + alpha * d[index];
                    self.phi[index] = self.upper[index].min(self.lower[index].max(moved));
                    r[k] -= alpha * q[k];
                    held[k] = self.phi[index] != moved;
                }
                if held.contains(&true) {
                    free = free.into_iter().zip(held).filter(|(_, held)| !held).map(|(i, _)| i).collect();
                    continue 'restart;
                }
                let before = std::mem::replace(&mut delta, dot(&r, &r));
                if converged(delta) {
                    return;
                }
                free.iter().zip(&r).for_each(|(&index, r)| d[index] = r + delta / before * d[index]);
            }
            return;
        }
    }

    /// The voxels with |φ| up to `width`.
    fn within(&self, width: f64) -> Vec<usize> {
        self.grid.interior.iter().copied().filter(|&index| self.phi[index].abs() <= width).collect()
    }
}

/// ∇⁴ at some voxels, by two rounds of differences.
struct Biharmonic {
    at: Vec<usize>,
    /// These voxels and their face neighbours: the first round computes values there.
    around: Vec<usize>,
    /// The values of the first round.
    laplacian: Vec<f64>,
}

impl Biharmonic {
    fn new(grid: &Grid, at: &[usize]) -> Biharmonic {
        let mut needed = vec![false; grid.len()];
        for &index in at {
            needed[index] = true;
            grid.faces(index).as_flattened().iter().for_each(|&face| needed[face] = true);
        }
        let around = (0..grid.len()).filter(|&index| needed[index]).collect();
        Biharmonic { at: at.to_vec(), around, laplacian: vec![0.0; grid.len()] }
    }

    fn apply(&mut self, grid: &Grid, values: &[f64]) -> Vec<f64> {
        for &index in &self.around {
            self.laplacian[index] = grid.laplacian(values, index);
        }
        self.at.iter().map(|&index| grid.laplacian(&self.laplacian, index)).collect()
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
