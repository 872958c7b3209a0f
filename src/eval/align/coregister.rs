//! stub
use super::{AlignSettings, Alignment, Residuals};
use crate::eval::Surface;
pub(super) fn coregister(_p: &Surface, _t: &Surface, _s: &AlignSettings, _a: &mut Alignment) {}
pub(super) fn residuals(_p: &Surface, _t: &Surface, _o: f64) -> Residuals {
    Residuals { pixels: 0, mean_m: 0.0, median_m: 0.0, std_m: 0.0, nmad_m: 0.0 }
}
