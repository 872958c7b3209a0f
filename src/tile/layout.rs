//! Where windows lie and how much each counts: pure arithmetic along one axis at a time.
//!
//! Windows form a grid, and a window's weight at a pixel is the product of its weights along x and along y.
//! The sum over all windows is then a product too, so weights are normalised along each axis by themselves,
//! in `f64`, and sum to one everywhere.

use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Pixels of a window along each side: what the network is trained on.
pub const WINDOW: u32 = 256;

/// Standard deviation of [`Blend::Gaussian`] as a share of the window, as in nnU-Net and MONAI.
pub const SIGMA: f64 = 0.125;

/// How windows are weighted where they overlap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Blend {
    /// All the same, as in the paper.
    #[default]
    Mean,
    /// The square of a sine: next to nothing at the border, most in the middle.
    Hann,
    /// A Gaussian about the middle, with a standard deviation of [`SIGMA`] of the window.
    Gaussian,
}

impl Blend {
    /// `mean`, `hann` or `gaussian`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mean => "mean",
            Self::Hann => "hann",
            Self::Gaussian => "gaussian",
        }
    }

    /// Weight of pixel `index` of a window before it is normalised; above 0.
    fn weight(self, index: u32) -> f64 {
        let size = f64::from(WINDOW);
        let at = f64::from(index) + 0.5;
        match self {
            Self::Mean => 1.0,
            Self::Hann => {
                let sine = libm::sin(std::f64::consts::PI * at / size);
                sine * sine
            }
            Self::Gaussian => {
                let away = (at / size - 0.5) / SIGMA;
                libm::exp(-0.5 * away * away)
            }
        }
    }
}

/// How windows follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WindowOptions {
    /// Pixels from one window to the next.
    pub stride: u32,
    /// Pixels that are dropped along each side of a window that does not lie on the picture's edge.
    pub trim: u32,
    /// Weights where windows overlap.
    pub blend: Blend,
}

impl Default for WindowOptions {
    /// As in the paper: every 128 pixels, nothing dropped, a plain mean.
    fn default() -> Self {
        Self { stride: 128, trim: 0, blend: Blend::Mean }
    }
}

/// Why windows cannot be laid out.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    /// No stride.
    #[error(
        "--stride 0: windows would never move; give 1 to {WINDOW} (pixels), 128 as in the paper"
    )]
    NoStride,
    /// Pixels that no window covers.
    #[error(
        "--stride {stride} with --trim {trim} leaves pixels that no window covers: a window of {WINDOW} less \
         {trim} on both sides reaches {reach} pixels; give --stride {reach} or less"
    )]
    Holes {
        /// The stride.
        stride: u32,
        /// Pixels dropped on each side.
        trim: u32,
        /// What is left of a window.
        reach: u32,
    },
    /// Nothing is left of a window.
    #[error("--trim {trim}: nothing is left of a window of {WINDOW} pixels; give less than {most}", most = WINDOW / 2)]
    Trim {
        /// Pixels dropped on each side.
        trim: u32,
    },
    /// A picture without pixels.
    #[error("a picture of no pixels")]
    Empty,
}

impl WindowOptions {
    /// Whether every pixel is covered.
    ///
    /// # Errors
    /// [`LayoutError`] naming the values.
    pub fn check(&self) -> Result<(), LayoutError> {
        let Self { stride, trim, .. } = *self;
        if stride == 0 {
            return Err(LayoutError::NoStride);
        }
        if trim >= WINDOW / 2 {
            return Err(LayoutError::Trim { trim });
        }
        let reach = WINDOW - 2 * trim;
        if stride > reach { Err(LayoutError::Holes { stride, trim, reach }) } else { Ok(()) }
    }
}

/// One window along an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisWindow {
    /// Its first pixel; negative where the picture is narrower than a window and lies in its middle.
    pub start: i64,
    /// The pixels of the picture that it counts for.
    pub pixels: Range<u32>,
    /// Its weight at each of them.
    pub weights: Vec<f32>,
}

/// All windows along an axis, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisWindows {
    windows: Vec<AxisWindow>,
}

impl AxisWindows {
    /// Windows over `length` pixels: at 0, one stride, two strides, and the last one at the edge. Fewer
    /// pixels than a window has lie in the middle of a single one.
    ///
    /// # Errors
    /// [`LayoutError`].
    pub fn new(length: u32, options: &WindowOptions) -> Result<Self, LayoutError> {
        options.check()?;
        if length == 0 {
            return Err(LayoutError::Empty);
        }
        if length <= WINDOW {
            let start = -i64::from((WINDOW - length) / 2);
            let weights = vec![1.0; length as usize];
            return Ok(Self { windows: vec![AxisWindow { start, pixels: 0..length, weights }] });
        }
        let last = length - WINDOW;
        let mut starts: Vec<u32> = (0..last).step_by(options.stride as usize).collect();
        starts.push(last);
        let spans: Vec<Range<u32>> = starts
            .iter()
            .map(|start| {
                let left = if *start == 0 { 0 } else { options.trim };
                let right = if *start == last { 0 } else { options.trim };
                start + left..start + WINDOW - right
            })
            .collect();
        let mut sums = vec![0.0_f64; length as usize];
        for (start, span) in starts.iter().zip(&spans) {
            for pixel in span.clone() {
                sums[pixel as usize] += options.blend.weight(pixel - start);
            }
        }
        let windows = starts
            .iter()
            .zip(spans)
            .map(|(start, span)| {
                let share = |pixel: u32| {
                    (options.blend.weight(pixel - start) / sums[pixel as usize]) as f32
                };
                let weights = span.clone().map(share).collect();
                AxisWindow { start: i64::from(*start), pixels: span, weights }
            })
            .collect();
        Ok(Self { windows })
    }

    /// The windows.
    #[must_use]
    pub fn all(&self) -> &[AxisWindow] {
        &self.windows
    }

    /// Numbers of the windows that count for any of these pixels.
    #[must_use]
    pub fn touching(&self, pixels: &Range<u32>) -> Range<usize> {
        let from = self.windows.partition_point(|window| window.pixels.end <= pixels.start);
        let to = self.windows.partition_point(|window| window.pixels.start < pixels.end);
        from..to.max(from)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLENDS: [Blend; 3] = [Blend::Mean, Blend::Hann, Blend::Gaussian];

    fn windows(length: u32, stride: u32, trim: u32, blend: Blend) -> AxisWindows {
        AxisWindows::new(length, &WindowOptions { stride, trim, blend }).expect("a layout")
    }

    fn starts(length: u32, stride: u32) -> Vec<i64> {
        windows(length, stride, 0, Blend::Mean).all().iter().map(|w| w.start).collect()
    }

    #[test]
    fn the_last_window_stands_at_the_edge() {
        assert_eq!(starts(512, 128), [0, 128, 256]);
        assert_eq!(starts(500, 128), [0, 128, 244]);
        assert_eq!(starts(257, 128), [0, 1]);
        assert_eq!(starts(256, 128), [0]);
        assert_eq!(starts(1000, 64).last(), Some(&744));
        assert_eq!(starts(512, 256), [0, 256]);
    }

    #[test]
    fn a_narrow_picture_lies_in_the_middle_of_one_window() {
        let narrow = windows(100, 128, 32, Blend::Hann);
        let [window] = narrow.all() else { panic!("one window") };
        assert_eq!((window.start, window.pixels.clone()), (-78, 0..100));
        assert!(window.weights.iter().all(|weight| *weight == 1.0));
        assert_eq!(windows(1, 1, 0, Blend::Mean).all()[0].start, -127);
    }

    #[test]
    fn weights_sum_to_one_everywhere() {
        for blend in BLENDS {
            for length in [1, 255, 256, 257, 300, 511, 512, 1000, 1337] {
                for (stride, trim) in
                    [(256, 0), (128, 0), (100, 0), (64, 32), (192, 32), (1, 0), (7, 100), (2, 127)]
                {
                    if length > 600 && stride < 7 {
                        continue;
                    }
                    let all = windows(length, stride, trim, blend);
                    let mut sums = vec![0.0_f64; length as usize];
                    for window in all.all() {
                        for (pixel, weight) in window.pixels.clone().zip(&window.weights) {
                            assert!(*weight >= 0.0 && *weight <= 1.0);
                            sums[pixel as usize] += f64::from(*weight);
                        }
                    }
                    for (pixel, sum) in sums.iter().enumerate() {
                        assert!(
                            (sum - 1.0).abs() < 1e-6,
                            "{blend:?} {length} {stride} {trim}: {sum} at {pixel}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn weights_are_a_raised_cosine_and_a_bell_of_32_pixels() {
        for index in [0_u32, 37, 127, 128, 255] {
            let at = f64::from(index) + 0.5;
            let cosine = 0.5 - 0.5 * libm::cos(std::f64::consts::TAU * at / 256.0);
            assert!((Blend::Hann.weight(index) - cosine).abs() < 1e-15, "{index}");
            let bell = libm::exp(-(at - 128.0) * (at - 128.0) / 2048.0);
            assert!((Blend::Gaussian.weight(index) - bell).abs() < 1e-15, "{index}");
        }
    }

    #[test]
    fn the_mean_counts_windows() {
        let all = windows(1000, 64, 32, Blend::Mean);
        // As the reference counts: how many trimmed windows cover a pixel.
        for pixel in [0_u32, 31, 100, 500, 712, 999] {
            let over: Vec<f32> = (all.all().iter())
                .filter(|w| w.pixels.contains(&pixel))
                .map(|w| w.weights[(pixel - w.pixels.start) as usize])
                .collect();
            assert!(over.iter().all(|w| (w - 1.0 / over.len() as f32).abs() < 1e-7), "{over:?}");
        }
    }

    #[test]
    fn touching_finds_exactly_those_that_count() {
        let all = windows(1000, 64, 32, Blend::Gaussian);
        for range in [0..1, 255..256, 256..512, 511..512, 700..999, 999..1000] {
            let found = all.touching(&range);
            for (number, window) in all.all().iter().enumerate() {
                let counts = window.pixels.start < range.end && window.pixels.end > range.start;
                assert_eq!(found.contains(&number), counts, "{range:?} {number}");
            }
        }
    }

    #[test]
    fn holes_are_refused() {
        let check = |stride, trim| WindowOptions { stride, trim, blend: Blend::Mean }.check();
        assert_eq!(check(256, 0), Ok(()));
        assert_eq!(check(192, 32), Ok(()));
        assert_eq!(check(193, 32), Err(LayoutError::Holes { stride: 193, trim: 32, reach: 192 }));
        assert_eq!(check(257, 0), Err(LayoutError::Holes { stride: 257, trim: 0, reach: 256 }));
        assert_eq!(check(0, 0), Err(LayoutError::NoStride));
        assert_eq!(check(1, 128), Err(LayoutError::Trim { trim: 128 }));
        let text = check(200, 40).expect_err("holes").to_string();
        assert!(text.contains("--stride 176 or less"), "{text}");
    }
}
