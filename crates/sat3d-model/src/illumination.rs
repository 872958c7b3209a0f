//! The illumination input: a histogram of the sky's colours in a panorama (MODEL_SPEC section 9.3).

/// Bins of one channel over [-1, 1].
const BINS: usize = 100;
/// Bins left out at the dark end, where masked pixels lie.
const DROPPED: usize = 10;

/// Values of the histogram: 90 for each of red, green and blue.
pub const HISTOGRAM_LEN: usize = 3 * (BINS - DROPPED);

/// Why two images do not make a histogram.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a panorama of {image} bytes (three a pixel) and a sky mask of {mask} bytes (one a pixel)")]
pub struct IlluminationError {
    /// Bytes of the panorama.
    pub image: usize,
    /// Bytes of the mask.
    pub mask: usize,
}

/// The 270 values that tell the network the sky's light: for red, green and blue the shares of the sky's
/// pixels in 90 equal bins.
///
/// `image` holds RGB bytes and `sky_mask` one byte a pixel (255 sky), both already resized to the 512 x 128 that
/// the network was trained with. The order of `f32` operations and the treatment of values on a bin's
/// edge are numpy's, so that the result is equal to the reference's, not only close.
///
/// # Errors
/// When the two do not have the same number of pixels.
pub fn sky_histogram(image: &[u8], sky_mask: &[u8]) -> Result<Vec<f32>, IlluminationError> {
    let value = |value: u8, mask: u8| {
        let mask = f32::from(mask) / 255.0;
        2.0 * (f32::from(value) / 255.0 * mask) - 1.0
    };
    histogram(image, sky_mask, &edges(-1.0), value)
}

/// The histogram as the released *evaluation* computes it, which is not what the network was trained with: the
/// mask is resized with the default filter instead of the nearest pixel, and cut at one half.
///
/// For comparing with the published scores only; [`sky_histogram`] is the network's input. `image` and
/// `sky_mask` are as there, the mask resized bicubically ([`crate::preprocess::resize_bicubic`]).
///
/// # Errors
/// As [`sky_histogram`].
pub fn sky_histogram_eval_variant(
    image: &[u8],
    sky_mask: &[u8],
) -> Result<Vec<f32>, IlluminationError> {
    let value = |value: u8, mask: u8| {
        let signed = 2.0 * (f32::from(value) / 255.0) - 1.0;
        if f32::from(mask) / 255.0 > 0.5 { signed + 1.0 } else { 0.0 }
    };
    histogram(image, sky_mask, &edges(0.0), value)
}

/// Shares of the values in each bin but the first ten, channel by channel.
fn histogram(
    image: &[u8],
    sky_mask: &[u8],
    edges: &[f32; BINS + 1],
    value: impl Fn(u8, u8) -> f32,
) -> Result<Vec<f32>, IlluminationError> {
    if image.len() != 3 * sky_mask.len() {
        return Err(IlluminationError { image: image.len(), mask: sky_mask.len() });
    }
    let mut counts = [[0_u64; BINS]; 3];
    for (pixel, mask) in image.chunks_exact(3).zip(sky_mask) {
        for (counts, channel) in counts.iter_mut().zip(pixel) {
            counts[bin(edges, value(*channel, *mask))] += 1;
        }
    }
    let mut histogram = Vec::with_capacity(HISTOGRAM_LEN);
    for counts in &counts {
        let kept = &counts[DROPPED..];
        let total = kept.iter().sum::<u64>().max(1) as f64;
        histogram.extend(kept.iter().map(|count| (*count as f64 / total) as f32));
    }
    Ok(histogram)
}

/// numpy's edges of bins from `start` to `start + 2` in single precision: k * 0.02 + start, rounded.
fn edges(start: f64) -> [f32; BINS + 1] {
    let mut edges: [f32; BINS + 1] =
        std::array::from_fn(|k| (k as f64 * (2.0 / BINS as f64) + start) as f32);
    edges[BINS] = (start + 2.0) as f32;
    edges
}

/// The bin whose lower edge is the last that `value` reaches; the upper end belongs to the last bin.
fn bin(edges: &[f32; BINS + 1], value: f32) -> usize {
    edges[1..BINS].partition_point(|edge| *edge <= value)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]
    use super::*;

    #[test]
    fn edges_are_closed_below() {
        let edges = edges(-1.0);
        assert_eq!(bin(&edges, -1.0), 0);
        assert_eq!(bin(&edges, edges[50]), 50);
        assert_eq!(bin(&edges, f32::from_bits(edges[51].to_bits() - 1)), 50);
        assert_eq!(bin(&edges, 1.0), 99);
    }

    #[test]
    fn no_sky_is_all_zeros_and_shares_sum_to_one() {
        let image = [200_u8, 10, 128].repeat(50);
        assert_eq!(sky_histogram(&image, &[0; 50]).unwrap(), vec![0.0; HISTOGRAM_LEN]);
        let histogram = sky_histogram(&image, &[255; 50]).unwrap();
        let sum = |channel: usize| histogram[channel * 90..][..90].iter().sum::<f32>();
        // Green 10 of 255 lies in the bins left out.
        assert_eq!((sum(0), sum(1), sum(2)), (1.0, 0.0, 1.0));
        let error = sky_histogram(&image, &[255; 49]).unwrap_err();
        assert_eq!(error, IlluminationError { image: 150, mask: 49 });
    }

    #[test]
    fn the_evaluations_variant_cuts_its_mask_at_one_half() {
        let image = [200_u8, 10, 128].repeat(50);
        let of = |mask: u8| sky_histogram_eval_variant(&image, &[mask; 50]).unwrap();
        assert_eq!(of(127), vec![0.0; HISTOGRAM_LEN]);
        assert_eq!(of(128), of(255));
        // A mask of zeros and ones leaves the two the same.
        assert_eq!(of(255), sky_histogram(&image, &[255; 50]).unwrap());
        assert!(sky_histogram_eval_variant(&image, &[255; 49]).is_err());
    }
}
