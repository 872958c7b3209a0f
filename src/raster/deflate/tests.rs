use super::*;
use proptest::prelude::*;

const WAYS: [(Samples, Compression); 5] = [
    (Samples::Words32, Compression::Fast),
    (Samples::Bytes, Compression::Fast),
    (Samples::Words32, Compression::Small),
    (Samples::Bytes, Compression::Small),
    (Samples::Bytes, Compression::Stored),
];

/// Compresses every way and decodes with two inflaters that share no code: zlib-rs (ours) and
/// miniz_oxide, which also checks the Adler-32.
fn round_trip(data: &[u8]) {
    for (samples, compression) in WAYS {
        let packed = deflate(data, samples, compression);
        let back = inflate(&packed, data.len()).expect("inflates");
        assert!(back == data, "{samples:?} {compression:?} of {} bytes", data.len());
        let stream = zlib(data, samples, compression);
        let back = miniz_oxide::inflate::decompress_to_vec_zlib(&stream).expect("miniz inflates");
        assert!(back == data, "miniz: {samples:?} {compression:?} of {} bytes", data.len());
    }
}

fn bytes_of(heights: impl IntoIterator<Item = f32>) -> Vec<u8> {
    heights.into_iter().flat_map(f32::to_le_bytes).collect()
}

/// A city of sorts: slopes, roofs and noise, in metres.
fn heights(width: usize, height: usize) -> Vec<f32> {
    let mut state = 1_u32;
    (0..width * height)
        .map(|i| {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = (state >> 16) as f32 / 65_536.0 * 0.02;
            let roof = if (x as u32 / 40 + y as u32 / 30).is_multiple_of(3) { 12.0 } else { 0.0 };
            50.0 + 0.013 * x + 0.007 * y + roof + noise
        })
        .collect()
}

#[test]
fn grids_of_every_kind_come_back() {
    let city = heights(320, 200);
    round_trip(&bytes_of(city.iter().copied()));
    let with_void = city.iter().enumerate().map(|(i, &h)| if i % 320 > 200 { f32::NAN } else { h });
    round_trip(&bytes_of(with_void));
    // Heights on few levels repeat, which is what the search for pairs is for.
    round_trip(&bytes_of(city.iter().map(|h| (h * 100.0).round() / 100.0)));
    round_trip(&bytes_of(city.iter().map(|h| (h * 4.0).round() / 4.0)));
    round_trip(&bytes_of(std::iter::repeat_n(f32::NAN, 70_000)));
    round_trip(&bytes_of((0..70_000).map(|i| i as f32)));
    // Void, then values, then void again, at every phase of the 258-byte matches.
    for n in 60..70 {
        let heights: Vec<f32> = [vec![f32::NAN; n], vec![1.0, 2.0], vec![f32::NAN; n]].concat();
        round_trip(&bytes_of(heights));
    }
}

#[test]
fn short_input_and_odd_lengths_come_back() {
    for len in (0..40).chain([255, 256, 257, 258, 259, 260, 261, 262, 65_535, 65_536, 65_537]) {
        round_trip(&vec![7; len]);
        round_trip(&(0..len).map(|i| ((i * i) >> 3) as u8).collect::<Vec<_>>());
    }
}

#[test]
fn noise_costs_no_more_than_storing_it() {
    let mut state = 1_u64;
    let noise: Vec<u8> = (0..300_000)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 56) as u8
        })
        .collect();
    round_trip(&noise);
    for samples in [Samples::Words32, Samples::Bytes] {
        let packed = deflate(&noise, samples, Compression::Fast);
        assert!(packed.len() < noise.len() + 100, "{}", packed.len());
    }
}

#[test]
fn constant_areas_cost_almost_nothing() {
    let packed = deflate(
        &bytes_of(std::iter::repeat_n(12.5, 640 * 640)),
        Samples::Words32,
        Compression::Fast,
    );
    assert!(packed.len() < 2500, "{}", packed.len());
}

#[test]
fn matches_reach_the_whole_window_and_no_farther() {
    // One block of values that occur once, repeated at the edge of the window: 8192 samples.
    let distinct = |n: u32| (0..n).map(|i| i.wrapping_mul(0x9E37_79B1)).collect::<Vec<u32>>();
    for period in [8191, 8192, 8193, 16_384] {
        let words = distinct(period);
        let data: Vec<u8> =
            [&words[..], &words, &words].concat().iter().flat_map(|w| w.to_le_bytes()).collect();
        round_trip(&data);
        let packed = deflate(&data, Samples::Words32, Compression::Fast).len();
        assert_eq!(packed < data.len() / 2, period <= 8192, "period {period}: {packed} bytes");
    }
}

#[test]
fn the_fast_encoder_is_as_small_as_zlib_level_6_within_7_per_cent() {
    let data = bytes_of(heights(640, 640));
    let fast = deflate(&data, Samples::Words32, Compression::Fast).len();
    // miniz finds matches of three bytes as zlib does; zlib-rs below level 9 looks for four.
    let reference = miniz_oxide::deflate::compress_to_vec(&data, 6).len();
    assert!(fast as f64 <= 1.07 * reference as f64, "{fast} against {reference}");
}

#[test]
fn damage_is_an_error() {
    let data = bytes_of(heights(64, 64));
    let packed = deflate(&data, Samples::Words32, Compression::Fast);
    assert_eq!(
        inflate(&packed, data.len() - 1),
        Err(InflateError::TooLong { expected: data.len() - 1 })
    );
    assert_eq!(
        inflate(&packed, data.len() + 1),
        Err(InflateError::TooShort { found: data.len(), expected: data.len() + 1 })
    );
    assert!(matches!(
        inflate(&packed[..packed.len() / 2], data.len()),
        Err(InflateError::Truncated { .. })
    ));
    assert!(matches!(inflate(&[], 10), Err(InflateError::Truncated { found: 0 })));
    // Block type 3 does not exist.
    assert_eq!(inflate(&[0x07, 0, 0], 10), Err(InflateError::Damaged));
    // A false size takes no memory: 2^60 bytes are stated.
    assert!(inflate(&packed, 1 << 60).is_err());
}

#[test]
fn adler32_agrees_with_its_definition() {
    let by_definition = |data: &[u8]| {
        let (mut a, mut b) = (1_u32, 0_u32);
        for &byte in data {
            a = (a + u32::from(byte)) % 65_521;
            b = (b + a) % 65_521;
        }
        b << 16 | a
    };
    assert_eq!(adler32(b"Wikipedia"), 0x11E6_0398);
    for len in [0, 1, 31, 32, 33, 5551, 5552, 5553, 100_000] {
        let data: Vec<u8> = (0..len).map(|i: usize| (i * 7 % 256) as u8 | 0xf0).collect();
        assert_eq!(adler32(&data), by_definition(&data), "{len}");
        assert_eq!(adler32(&vec![255; len]), by_definition(&vec![255; len]), "{len}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_bytes_come_back(data in prop::collection::vec(any::<u8>(), 0..3000)) {
        round_trip(&data);
    }

    /// Pieces that repeat at any distance and phase, between noise.
    #[test]
    fn repetitions_come_back(
        pieces in prop::collection::vec(
            (prop::collection::vec(any::<u8>(), 1..20), 1..80_usize), 1..30),
    ) {
        let data: Vec<u8> = pieces.into_iter().flat_map(|(p, n)| p.repeat(n)).collect();
        round_trip(&data);
    }

    #[test]
    fn grids_on_few_levels_come_back(
        levels in prop::collection::vec(any::<u32>(), 1..6),
        picks in prop::collection::vec((any::<prop::sample::Index>(), 1..200_usize), 1..200),
    ) {
        let data: Vec<u8> = picks
            .into_iter()
            .flat_map(|(pick, n)| levels[pick.index(levels.len())].to_le_bytes().repeat(n))
            .collect();
        round_trip(&data);
    }
}
