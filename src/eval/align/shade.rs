//! Heights as 8-bit shades between their 2nd and 98th percentiles, for the published protocol.

/// Writes one shade per height into `shades`; no data becomes 0. Returns whether there is any
/// texture: false (and all shades 0) when nothing is valid or both percentiles are equal.
///
/// Arithmetic is that of `NumPy` on 32-bit floats, because a shade that differs by one could turn a
/// near tie of two shifts.
pub(super) fn shade(heights: &[f32], keys: &mut Vec<u32>, shades: &mut Vec<u8>) -> bool {
    shades.clear();
    keys.clear();
    keys.extend(heights.iter().filter(|v| !v.is_nan()).map(|v| sortable(*v)));
    let limits =
        if keys.is_empty() { None } else { Some((percentile(keys, 2.0), percentile(keys, 98.0))) };
    match limits {
        // A range that overflows carries no shades either.
        Some((low, high)) if low < high && (high - low).is_finite() => {
            let range = high - low;
            shades.extend(heights.iter().map(|v| {
                let scaled = 255.0 * (v.clamp(low, high) - low) / range;
                // A cast takes NaN to 0 and cuts off the fraction, as wanted.
                scaled as u8
            }));
            shades.iter().any(|s| *s != shades[0])
        }
        _ => {
            shades.resize(heights.len(), 0);
            false
        }
    }
}

/// An integer that sorts like the float: selection on integers needs no branch per comparison.
const fn sortable(value: f32) -> u32 {
    let bits = value.to_bits();
    if bits >> 31 == 0 { bits | 0x8000_0000 } else { !bits }
}

/// Inverse of [`sortable`].
const fn unsortable(key: u32) -> f32 {
    f32::from_bits(if key >> 31 == 1 { key & 0x7FFF_FFFF } else { !key })
}

/// Percentile by linear interpolation between order statistics, for a non-empty list.
fn percentile(keys: &mut [u32], per_cent: f64) -> f32 {
    let position = (keys.len() - 1) as f64 * (per_cent / 100.0);
    let below = position.floor();
    let fraction = position - below;
    let (_, first, above) = keys.select_nth_unstable(below as usize);
    let first = unsortable(*first);
    let second = above.iter().min().map_or(first, |key| unsortable(*key));
    let step = second - first;
    // NumPy interpolates from the nearer end.
    if fraction >= 0.5 {
        second - step * (1.0 - fraction) as f32
    } else {
        first + step * fraction as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_numpy() {
        // np.percentile(np.float32([3.5, -1.25, 7.75, 0.1, 2.2, 9.9, -4.4]), [2, 50, 98])
        let values = [3.5_f32, -1.25, 7.75, 0.1, 2.2, 9.9, -4.4];
        let mut keys: Vec<u32> = values.iter().map(|v| sortable(*v)).collect();
        for (per_cent, expected) in [(2.0, -4.022_f32), (50.0, 2.2), (98.0, 9.641_999)] {
            let found = percentile(&mut keys, per_cent);
            assert!((found - expected).abs() < 2e-6, "{per_cent}: {found} and {expected}");
        }
        for value in [0.0_f32, -0.0, 1.5, -1.5, f32::MAX, f32::MIN, f32::INFINITY] {
            assert_eq!(unsortable(sortable(value)).to_bits(), value.to_bits());
        }
    }

    #[test]
    fn shades_span_the_range_and_flat_heights_have_none() {
        let (mut keys, mut shades) = (Vec::new(), Vec::new());
        let ramp: Vec<f32> = (0..=100).map(|i| i as f32).chain([f32::NAN]).collect();
        assert!(shade(&ramp, &mut keys, &mut shades));
        assert_eq!(
            (shades[0], shades[2], shades[50], shades[98], shades[100]),
            (0, 0, 127, 255, 255)
        );
        assert_eq!(shades[101], 0);
        for flat in [vec![], vec![f32::NAN; 9], vec![4.0; 9], vec![f32::NAN, 3.0, f32::NAN]] {
            assert!(!shade(&flat, &mut keys, &mut shades));
            assert_eq!(shades, vec![0; flat.len()]);
        }
        assert!(!shade(&[f32::MAX, f32::MIN, f32::MAX, f32::MIN], &mut keys, &mut shades));
    }
}
