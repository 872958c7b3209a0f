//! Colour maps that pictures and reports share.
//!
//! All three are our own, so they have no licence but this project's. They are paths in Oklab
//! (B. Ottosson, 2020) of colours equally far apart, so that equal differences of a value look
//! equal, and their lightness rises or falls all the way (from the middle, in [`DIVERGING`]), so
//! that they read the same for people who do not tell red from green, and in grey print. Between
//! the colours a map is joined by straight lines in sRGB.

/// Heights, sRGB, lowest first: from blue over green to sand. Lightness ends well above black, so
/// that shadows show on low ground too.
pub const HEIGHT: [[u8; 3]; 17] = [
    [63, 72, 126],
    [58, 84, 135],
    [52, 96, 142],
    [46, 108, 147],
    [42, 120, 150],
    [42, 131, 151],
    [49, 142, 150],
    [62, 153, 149],
    [79, 162, 146],
    [97, 172, 143],
    [117, 180, 139],
    [138, 188, 135],
    [160, 194, 132],
    [183, 200, 130],
    [206, 205, 131],
    [228, 210, 134],
    [249, 214, 140],
];

/// Signed errors, sRGB: blue below zero, nearly white at zero, brown above. Both ends are equally
/// far from the middle, and equally dark within 0.02 of Oklab's lightness.
pub const DIVERGING: [[u8; 3]; 17] = [
    [31, 67, 138],
    [43, 90, 160],
    [57, 112, 180],
    [77, 135, 198],
    [102, 158, 211],
    [131, 180, 222],
    [164, 201, 230],
    [199, 221, 236],
    [238, 238, 238],
    [233, 215, 197],
    [225, 190, 160],
    [215, 165, 126],
    [204, 139, 95],
    [190, 114, 69],
    [172, 90, 47],
    [152, 67, 29],
    [131, 45, 15],
];

/// Sizes of errors, sRGB, smallest first: from pale yellow over orange to dark plum. On a dark
/// ground it is used backwards, so that large errors stand out there too.
pub const MAGNITUDE: [[u8; 3]; 16] = [
    [249, 240, 186],
    [249, 225, 147],
    [250, 207, 110],
    [251, 186, 74],
    [251, 165, 34],
    [250, 143, 0],
    [245, 120, 0],
    [237, 98, 0],
    [226, 78, 9],
    [212, 59, 36],
    [195, 43, 51],
    [176, 30, 60],
    [155, 24, 66],
    [133, 22, 69],
    [110, 23, 68],
    [88, 27, 63],
];

/// A map sampled at `N` equal steps, its first and last colour included.
#[must_use]
pub fn table<const N: usize>(map: &[[u8; 3]]) -> [[u8; 3]; N] {
    std::array::from_fn(|step| {
        let at = step as f64 / N.saturating_sub(1).max(1) as f64 * (map.len() - 1) as f64;
        let below = (at as usize).min(map.len().saturating_sub(2));
        let above = (below + 1).min(map.len() - 1);
        let fraction = at - below as f64;
        std::array::from_fn(|channel| {
            let [low, high] = [below, above].map(|i| f64::from(map[i][channel]));
            (low + fraction * (high - low) + 0.5) as u8
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oklab of an sRGB colour, by the matrices of its author.
    fn oklab(colour: [u8; 3]) -> [f64; 3] {
        let [r, g, b] = colour.map(|value| {
            let value = f64::from(value) / 255.0;
            if value <= 0.04045 { value / 12.92 } else { libm::pow((value + 0.055) / 1.055, 2.4) }
        });
        let l = libm::cbrt(0.412_221_470_8 * r + 0.536_332_536_3 * g + 0.051_445_992_9 * b);
        let m = libm::cbrt(0.211_903_498_2 * r + 0.680_699_545_1 * g + 0.107_396_956_6 * b);
        let s = libm::cbrt(0.088_302_461_9 * r + 0.281_718_837_6 * g + 0.629_978_700_5 * b);
        [
            0.210_454_255_3 * l + 0.793_617_785_0 * m - 0.004_072_046_8 * s,
            1.977_998_495_1 * l - 2.428_592_205_0 * m + 0.450_593_709_9 * s,
            0.025_904_037_1 * l + 0.782_771_766_2 * m - 0.808_675_766_0 * s,
        ]
    }

    fn steps(map: &[[u8; 3]]) -> Vec<f64> {
        map.windows(2)
            .map(|pair| {
                let [a, b] = [oklab(pair[0]), oklab(pair[1])];
                a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
            })
            .collect()
    }

    #[test]
    fn steps_look_equal() {
        for map in [&HEIGHT[..], &DIVERGING[..], &MAGNITUDE[..]] {
            let steps = steps(map);
            let low = steps.iter().copied().fold(f64::MAX, f64::min);
            let high = steps.iter().copied().fold(0.0, f64::max);
            assert!(high < 1.2 * low, "{steps:?}");
        }
    }

    #[test]
    fn lightness_never_turns_but_at_the_middle_of_the_diverging_map() {
        let lightness =
            |map: &[[u8; 3]]| -> Vec<f64> { map.iter().map(|c| oklab(*c)[0]).collect() };
        assert!(lightness(&HEIGHT).is_sorted());
        assert!(lightness(&MAGNITUDE).is_sorted_by(|a, b| a > b));
        let diverging = lightness(&DIVERGING);
        assert!(diverging[..9].is_sorted() && diverging[8..].is_sorted_by(|a, b| a > b));
        assert!((diverging[0] - diverging[16]).abs() < 0.03, "{diverging:?}");
    }

    #[test]
    fn tables_begin_and_end_with_the_map() {
        let long = table::<1024>(&HEIGHT);
        assert_eq!((long[0], long[1023]), (HEIGHT[0], HEIGHT[16]));
        assert_eq!(table::<17>(&DIVERGING), DIVERGING);
        assert_eq!(table::<1>(&HEIGHT), [HEIGHT[0]]);
        assert_eq!(table::<2>(&[[1, 2, 3]]), [[1, 2, 3]; 2]);
        // Half of the way between two neighbours, rounded half up.
        assert_eq!(table::<3>(&[[0, 10, 255], [1, 20, 0]])[1], [1, 15, 128]);
    }
}
