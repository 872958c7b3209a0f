//! One ray through a medium: coarse samples, importance samples, both integrated together.

use super::quadrature::{CellRoom, Hit, ImportanceRoom, cells, midpoint};
use super::{SampleCounts, Sampling};
use crate::field::{DensityActivation, Medium};
use pulp::Arch;

/// Marches rays; its buffers are kept from ray to ray.
pub(crate) struct March {
    arch: Arch,
    sampling: Sampling,
    counts: SampleCounts,
    activation: DensityActivation,
    /// Radii of the samples, coarse ones first, then fine ones; each part ascending.
    pub radii: Vec<f32>,
    /// Raw densities, in that order.
    pub raw: Vec<f32>,
    /// Hidden values, in that order, where wanted.
    pub hidden: Vec<f32>,
    /// What each sample contributes to the ray's colour, in that order.
    pub shares: Vec<f32>,
    /// Weights of the coarse intervals.
    pub coarse_weights: Vec<f32>,
    /// All radii, ascending.
    pub merged_radii: Vec<f32>,
    /// Raw densities at them.
    pub merged_raw: Vec<f32>,
    source: Vec<u16>,
    weights: Vec<f32>,
    fine: Vec<f32>,
    sigma: Vec<f32>,
    edges: Vec<f64>,
    cell_room: CellRoom,
    importance: ImportanceRoom,
}

struct SigmaOp<'a> {
    activation: DensityActivation,
    raw: &'a [f32],
    sigma: &'a mut [f32],
}

impl pulp::NullaryFnOnce for SigmaOp<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (sigma, raw) in self.sigma.iter_mut().zip(self.raw) {
            *sigma = self.activation.apply(*raw);
        }
    }
}

impl March {
    pub fn new(
        arch: Arch,
        sampling: Sampling,
        counts: SampleCounts,
        activation: DensityActivation,
    ) -> Self {
        Self {
            arch,
            sampling,
            counts,
            activation,
            radii: Vec::new(),
            raw: Vec::new(),
            hidden: Vec::new(),
            shares: Vec::new(),
            coarse_weights: Vec::new(),
            merged_radii: Vec::new(),
            merged_raw: Vec::new(),
            source: Vec::new(),
            weights: Vec::new(),
            fine: Vec::new(),
            sigma: Vec::new(),
            edges: Vec::new(),
            cell_room: CellRoom::default(),
            importance: ImportanceRoom::default(),
        }
    }

    /// Integrates a ray of this length (above 0); with `store`, hidden values and shares are kept for
    /// colours.
    pub fn run(&mut self, length: f64, medium: &mut impl Medium, store: bool) -> Hit {
        let (coarse, fine) = (self.counts.coarse(), self.counts.fine());
        let step = length / coarse as f64;
        // The released sampler never looks into its first interval: bins start at 1.
        let first = match self.sampling {
            Sampling::Reference => 1.5,
            Sampling::Stable => 0.5,
        };
        self.radii.clear();
        self.radii.extend((0..coarse).map(|k| ((k as f64 + first) * step) as f32));
        self.raw.clear();
        self.raw.resize(coarse + fine, 0.0);
        let width = if store { medium.hidden() } else { 0 };
        self.hidden.resize((coarse + fine) * width, 0.0);
        let (coarse_raw, fine_raw) = self.raw.split_at_mut(coarse);
        let (coarse_hidden, fine_hidden) = self.hidden.split_at_mut(coarse * width);
        medium.raw(&self.radii, coarse_raw, store.then_some(coarse_hidden));
        match self.sampling {
            Sampling::Reference => {
                let weights = &mut self.coarse_weights;
                midpoint(self.arch, &self.radii, coarse_raw, self.activation, weights);
                self.importance.released(&self.radii, weights, fine, &mut self.fine);
            }
            Sampling::Stable => {
                self.edges.clear();
                self.edges.extend((0..=coarse).map(|k| k as f64 * step));
                self.sigma.resize(coarse, 0.0);
                let (activation, sigma) = (self.activation, &mut self.sigma[..]);
                self.arch.dispatch(SigmaOp { activation, raw: coarse_raw, sigma });
                let weights = &mut self.coarse_weights;
                cells(self.arch, &self.edges, &self.sigma, &mut self.cell_room, weights);
                self.importance.over_cells(&self.edges, weights, fine, &mut self.fine);
            }
        }
        medium.raw(&self.fine, fine_raw, store.then_some(fine_hidden));
        self.radii.extend_from_slice(&self.fine);
        self.merge(coarse);
        let hit = match self.sampling {
            Sampling::Reference => {
                let (radii, raw) = (&self.merged_radii, &self.merged_raw);
                midpoint(self.arch, radii, raw, self.activation, &mut self.weights)
            }
            Sampling::Stable => {
                self.edges.clear();
                self.edges.push(0.0);
                let middle = |pair: &[f32]| 0.5 * (f64::from(pair[0]) + f64::from(pair[1]));
                self.edges.extend(self.merged_radii.windows(2).map(middle));
                self.edges.push(length);
                self.sigma.resize(coarse + fine, 0.0);
                let (activation, sigma) = (self.activation, &mut self.sigma[..]);
                self.arch.dispatch(SigmaOp { activation, raw: &self.merged_raw, sigma });
                let room = &mut self.cell_room;
                cells(self.arch, &self.edges, &self.sigma, room, &mut self.weights)
            }
        };
        if store {
            self.share();
        }
        hit
    }

    /// Sorts both ascending lists into one; of equal radii the coarse one comes first.
    fn merge(&mut self, coarse: usize) {
        let count = self.radii.len();
        self.merged_radii.resize(count, 0.0);
        self.merged_raw.resize(count, 0.0);
        self.source.resize(count, 0);
        let (mut a, mut b) = (0, coarse);
        for k in 0..count {
            let take_coarse = b == count || (a < coarse && self.radii[a] <= self.radii[b]);
            let from = if take_coarse { a } else { b };
            a += usize::from(take_coarse);
            b += usize::from(!take_coarse);
            self.merged_radii[k] = self.radii[from];
            self.merged_raw[k] = self.raw[from];
            self.source[k] = from as u16;
        }
    }

    /// Weights of intervals or cells -> shares of samples.
    fn share(&mut self) {
        self.shares.clear();
        self.shares.resize(self.radii.len(), 0.0);
        match self.sampling {
            // The released rule averages the colours at an interval's ends.
            Sampling::Reference => {
                for (weight, ends) in self.weights.iter().zip(self.source.windows(2)) {
                    self.shares[usize::from(ends[0])] += 0.5 * weight;
                    self.shares[usize::from(ends[1])] += 0.5 * weight;
                }
            }
            Sampling::Stable => {
                for (weight, source) in self.weights.iter().zip(&self.source) {
                    self.shares[usize::from(*source)] += weight;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall that begins within the ray, and a haze before it.
    struct Haze;

    impl Medium for Haze {
        fn raw(&mut self, radii: &[f32], raw: &mut [f32], _hidden: Option<&mut [f32]>) {
            for (raw, radius) in raw.iter_mut().zip(radii) {
                *raw = if *radius < 0.7 { 0.4 } else { 9.0 };
            }
        }

        fn hidden(&self) -> usize {
            0
        }
    }

    #[test]
    fn samples_share_all_the_light_that_ends_and_where_it_ends() {
        for (sampling, apart) in [(Sampling::Reference, 1e-6), (Sampling::Stable, 2e-2)] {
            let counts = SampleCounts::new(24, 24).expect("counts");
            let activation = DensityActivation::Mipnerf;
            let mut march = March::new(Arch::new(), sampling, counts, activation);
            let hit = march.run(1.3, &mut Haze, true);
            assert_eq!(march.shares.len(), 48);
            let sum = |of: &dyn Fn(f64) -> f64| -> f64 {
                let samples = march.shares.iter().zip(&march.radii);
                samples.map(|(share, radius)| f64::from(*share) * of(f64::from(*radius))).sum()
            };
            let light = sum(&|_| 1.0);
            assert!(hit.opacity > 0.5 && (light - hit.opacity).abs() < 1e-6, "{light} {hit:?}");
            // The released rule puts an interval's light in its middle, which its ends share; the stable one in a cell.
            let distance = sum(&|radius| radius);
            assert!((distance - hit.distance).abs() < apart, "{sampling:?}: {distance} {hit:?}");
        }
    }
}
