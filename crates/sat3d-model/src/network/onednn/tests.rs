//! Passes and layers beside plain loops and beside burn.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::layers::phase_weights;
use super::map::{Context, Map, Shape};
use super::passes::{Change, GroupNorm, Target, constants, halve, interleave, prepared};
use super::*;
use crate::config::GROUPS;
use crate::network::Execution;
use crate::random::Draw;
use crate::weights::PackedWeights;
use crate::weights::rule::{RuleWeights, tiny_overrides};

const TINY: &str = include_str!("../../../fixtures/tiny/model/config.json");

fn context() -> Option<Context> {
    match Library::get() {
        Ok(library) => Some(Context::new(library).unwrap()),
        Err(why) => {
            println!("SKIPPED: {why}");
            None
        }
    }
}

/// Values around `centre`.
fn grid(channels: usize, side: [usize; 2], centre: f32) -> Grid {
    let draw = &mut Draw::new(&[7]);
    let values = (0..channels * side[0] * side[1]).map(|_| centre + draw.range(-1.0, 1.0) as f32);
    Grid::new(channels, side[0], side[1], values.collect())
}

#[test]
fn maps_come_back_in_both_orders_with_zeros_around() {
    let Some(mut context) = context() else { return };
    let plain = grid(32, [3, 5], 0.0);
    for order in [Order::Pixels, Order::Blocks] {
        let map = Map::of_grid(&mut context, &plain, 0, order).unwrap();
        assert_eq!(map.to_grid(), plain, "{order:?}");
        let wide = Map::of_grid(&mut context, &plain, 2, order).unwrap().to_grid();
        assert_eq!((wide.height, wide.width), (7, 9));
        for channel in 0..32 {
            for row in 0..7 {
                for column in 0..9 {
                    let inside = (2..5).contains(&row) && (2..7).contains(&column);
                    let wanted = if inside {
                        plain.channel(channel)[(row - 2) * 5 + column - 2]
                    } else {
                        0.0
                    };
                    assert_eq!(wide.channel(channel)[row * 9 + column], wanted);
                }
            }
        }
    }
}

#[test]
fn group_norms_are_exact_where_the_mean_is_far_larger_than_the_deviation() {
    let Some(mut context) = context() else { return };
    let channels = 2 * GROUPS;
    let norm = GroupNorm { gain: vec![1.5; channels], shift: vec![0.25; channels] };
    for centre in [0.0_f32, 3.0, 1e3, -1e5] {
        let plain = grid(channels, [20, 30], centre);
        for order in [Order::Pixels, Order::Blocks] {
            let map = Map::of_grid(&mut context, &plain, 0, order).unwrap();
            let found = constants(&map, &norm);
            for group in 0..GROUPS {
                let values: Vec<f64> = (2 * group..2 * group + 2)
                    .flat_map(|channel| plain.channel(channel))
                    .map(|value| f64::from(*value))
                    .collect();
                let count = values.len() as f64;
                let mean = values.iter().sum::<f64>() / count;
                let square = |value: &f64| (value - mean) * (value - mean);
                let variance = values.iter().map(square).sum::<f64>() / count;
                let [seen, scale, shift] = found[2 * group].map(f64::from);
                assert!(
                    (seen - mean).abs() <= 1e-7 * mean.abs() + 1e-6,
                    "{centre}: {seen}, {mean}"
                );
                let wanted = 1.5 / (variance + 1e-6).sqrt();
                assert!(
                    (scale / wanted - 1.0).abs() < 2e-6,
                    "{centre} {order:?}: {scale}, {wanted}"
                );
                assert_eq!(shift, 0.25);
            }
        }
    }
    // Sums of squares without the first value taken off would say nothing here.
    let naive: f32 = grid(1, [20, 30], -1e5).data.iter().map(|value| value * value).sum();
    let mean: f32 = grid(1, [20, 30], -1e5).data.iter().sum::<f32>() / 600.0;
    assert!((naive / 600.0 - mean * mean - 0.33).abs() > 1.0);
}

#[test]
fn a_pass_normalises_wraps_doubles_and_rounds() {
    let Some(mut context) = context() else { return };
    let plain = grid(32, [4, 6], 0.5);
    let norm: Vec<[f32; 3]> =
        (0..32).map(|c| [0.1 * c as f32, 2.0 - 0.05 * c as f32, 0.3]).collect();
    for order in [Order::Pixels, Order::Blocks] {
        let map = Map::of_grid(&mut context, &plain, 0, order).unwrap();
        for doubled in [false, true] {
            for wrapped in [false, true] {
                for element in [Element::F32, Element::Bf16] {
                    let target = Target { element, wrapped, doubled };
                    let change = Change::NormSwish(&norm);
                    let memory = prepared(&mut context, &map, &change, target).unwrap();
                    let [height, width] = target.size([4, 6]);
                    let lanes = map.lanes();
                    for (channel, [mean, scale, shift]) in norm.iter().enumerate() {
                        for row in 0..height {
                            for column in 0..width {
                                let from = |at: usize, side: usize| {
                                    let scale = if doubled { 2 } else { 1 };
                                    let margin = usize::from(wrapped);
                                    (at + side * scale - margin) % (side * scale) / scale
                                };
                                let value =
                                    plain.channel(channel)[from(row, 4) * 6 + from(column, 6)];
                                let value = f64::from((value - mean) * scale + shift);
                                let wanted = value / (1.0 + libm::exp(-value));
                                let pixel = row * width + column;
                                let at = (channel / lanes * height * width + pixel) * lanes
                                    + channel % lanes;
                                let (found, within) = match element {
                                    Element::F32 => (memory.floats()[at], 1e-6),
                                    Element::Bf16 => {
                                        let bits = u32::from(memory.halves()[at]) << 16;
                                        (f32::from_bits(bits), 4e-3 * wanted.abs() + 1e-6)
                                    }
                                };
                                let apart = (f64::from(found) - wanted).abs();
                                assert!(apart <= within, "{target:?} {order:?}: {found}, {wanted}");
                            }
                        }
                    }
                    context.put(memory);
                }
            }
        }
    }
}

#[test]
fn sixteen_bits_are_rounded_to_the_nearest_even_and_a_nan_stays_one() {
    let values =
        [1.0, 1.0 + 2f32.powi(-8), 1.0 + 3.0 * 2f32.powi(-8), -0.0, f32::INFINITY, f32::MAX];
    let mut out = [0; 6];
    halve(&values, &mut out);
    let back = out.map(|half| f32::from_bits(u32::from(half) << 16));
    assert_eq!(back[..3], [1.0, 1.0, 1.0 + 2f32.powi(-6)]);
    assert_eq!(back[3].to_bits(), (-0.0_f32).to_bits());
    assert_eq!(back[4..], [f32::INFINITY, f32::INFINITY]);
    let mut nan = [0];
    halve(&[f32::from_bits(0x7f80_0001)], &mut nan);
    assert!(f32::from_bits(u32::from(nan[0]) << 16).is_nan());
}

#[test]
fn four_convolutions_of_two_by_two_are_one_of_three_by_three_of_the_doubled_map() {
    let weights: Vec<f32> = (0..9).map(|index| (index as f32 - 3.0) * 0.37).collect();
    let (height, width) = (3_usize, 4_usize);
    let map = grid(1, [height, width], 0.0).data;
    let at = |row: isize, column: isize| -> f64 {
        let inside =
            (0..2 * height as isize).contains(&row) && (0..2 * width as isize).contains(&column);
        if inside { f64::from(map[row as usize / 2 * width + column as usize / 2]) } else { 0.0 }
    };
    for row in 0..2 * height {
        for column in 0..2 * width {
            let mut wanted = 0.0;
            for y in 0..3 {
                for x in 0..3 {
                    let (from_y, from_x) = ((row + y) as isize - 1, (column + x) as isize - 1);
                    wanted += f64::from(weights[3 * y + x]) * at(from_y, from_x);
                }
            }
            let odd = [row % 2, column % 2];
            let phase = phase_weights(&weights, odd);
            let mut found = 0.0;
            for y in 0..2 {
                for x in 0..2 {
                    // Before an even row or column, after an odd one.
                    let from = |place: usize, tap: usize, odd: usize| {
                        2 * (place as isize / 2 + tap as isize + odd as isize - 1)
                    };
                    let value = at(from(row, y, odd[0]), from(column, x, odd[1]));
                    found += f64::from(phase[2 * y + x]) * value;
                }
            }
            assert!((found - wanted).abs() < 1e-6, "{row} {column}: {found}, {wanted}");
        }
    }
}

#[test]
fn phases_are_put_together_in_both_orders() {
    let Some(mut context) = context() else { return };
    for order in [Order::Pixels, Order::Blocks] {
        let parts = [0.0, 1.0, 2.0, 3.0]
            .map(|value| Map::of_grid(&mut context, &grid(32, [2, 3], value), 0, order).unwrap());
        let shape = Shape { channels: 32, height: 4, width: 6 };
        let mut whole = Map::take(&mut context, shape, order).unwrap();
        interleave(&parts, &mut whole);
        let whole = whole.to_grid();
        for channel in 0..32 {
            for row in 0..4 {
                for column in 0..6 {
                    let part = parts[row % 2 * 2 + column % 2].to_grid();
                    let wanted = part.channel(channel)[row / 2 * 3 + column / 2];
                    assert_eq!(whole.channel(channel)[row * 6 + column], wanted);
                }
            }
        }
    }
}

/// A small network by each engine.
fn networks(
    config: &Config,
    precision: Precision,
    outliers: bool,
) -> Option<[Box<dyn StagedNetwork>; 2]> {
    let execution =
        Execution { device: Device::Cpu, engine: crate::network::Engine::OneDnn, precision };
    if let Some(why) = execution.refusal() {
        println!("SKIPPED: {execution}: {why}");
        return None;
    }
    let weights = || {
        let weights = RuleWeights::new(config, tiny_overrides());
        Box::new(if outliers { weights.with_outliers(3) } else { weights })
    };
    let burn = Execution::from(Device::Cpu).network(config.clone(), weights()).unwrap();
    Some([execution.network(config.clone(), weights()).unwrap(), burn])
}

fn apart(a: &Grid, b: &Grid) -> f64 {
    assert_eq!((a.channels, a.height, a.width), (b.channels, b.height, b.width));
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let apart = square(&mut a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b)));
    (apart / square(&mut b.data.iter().map(|b| f64::from(*b)))).sqrt()
}

#[test]
fn every_stage_is_burns_for_every_configuration() {
    let unpadded = TINY.replace("\"pad\": 0.125,", "");
    // 24 channels make no whole blocks.
    let triplane = TINY.replace("\"oneplane\"", "\"triplane\"");
    assert!(unpadded != TINY && triplane != TINY);
    for (name, text) in [("tiny", TINY), ("unpadded", &unpadded), ("triplane", &triplane)] {
        let config = Config::from_json(text).unwrap();
        let image = grid(3, [256, 256], 0.0);
        for precision in Precision::ALL {
            for outliers in [false, true] {
                let Some([ours, burn]) = networks(&config, precision, outliers) else { continue };
                let bound = precision.bound();
                // Harder weights cost 16-bit floats up to three times as much.
                let times = if outliers && precision == Precision::Bf16 { 4.0 } else { 1.0 };
                let (tokens, wanted) =
                    (ours.tokens(&image, None).unwrap(), burn.tokens(&image, None).unwrap());
                let found = apart(&tokens, &wanted);
                assert!(found <= times * bound.tokens, "{name} {precision} tokens: {found}");
                let (map, wanted) = (ours.map(&image).unwrap(), burn.map(&image).unwrap());
                let found = apart(&map, &wanted);
                assert!(found <= times * bound.planes, "{name} {precision} planes: {found}");
                // Twice the same.
                assert_eq!(ours.map(&image).unwrap(), map, "{name} {precision}");
            }
        }
        let Some([ours, burn]) = networks(&config, Precision::Fp32, false) else { continue };
        let style = burn.style(&[1.0 / 270.0; 270]).unwrap();
        assert_eq!(ours.style(&[1.0 / 270.0; 270]).unwrap(), style);
        let (sky, wanted) = (ours.sky(&style).unwrap(), burn.sky(&style).unwrap());
        assert!(apart(&sky, &wanted) < 1e-5, "{name} sky");
    }
}

#[test]
fn a_wrong_input_is_refused_as_by_burn() {
    let config = Config::from_json(TINY).unwrap();
    let Some([ours, burn]) = networks(&config, Precision::Fp32, false) else { return };
    let small = grid(3, [8, 8], 0.0);
    let errors = [ours.map(&small), burn.map(&small)].map(|made| made.unwrap_err().to_string());
    assert_eq!(errors[0], errors[1]);
    assert!(ours.sky(&[0.0; 3]).is_err() && ours.decode(&small, None).is_err());
}

#[test]
fn calls_from_several_threads_take_turns() {
    let config = Config::from_json(TINY).unwrap();
    let Some([ours, _]) = networks(&config, Precision::Fp32, false) else { return };
    let image = grid(3, [256, 256], 0.0);
    let first = ours.map(&image).unwrap();
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..3).map(|_| scope.spawn(|| ours.map(&image).unwrap())).collect();
        for thread in threads {
            assert_eq!(thread.join().unwrap(), first);
        }
    });
}

/// Weights of which packed ones are kept.
struct Keeping {
    weights: RuleWeights,
    packed: PackedWeights,
}

impl TensorSource for Keeping {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        self.weights.read(key, shape)
    }

    fn packed(&self) -> Option<&PackedWeights> {
        Some(&self.packed)
    }
}

#[test]
fn weights_that_were_kept_make_the_same_network_bit_for_bit() {
    let config = Config::from_json(TINY).unwrap();
    let image = grid(3, [256, 256], 0.0);
    let folder = tempfile::tempdir().unwrap();
    for precision in Precision::ALL {
        let Some([plain, _]) = networks(&config, precision, false) else { continue };
        let map = plain.map(&image).unwrap();
        let made = || {
            let weights = RuleWeights::new(&config, tiny_overrides());
            let packed = PackedWeights::in_folder(folder.path().to_owned());
            let source = Arc::new(Keeping { weights, packed });
            let network =
                OneDnnNetwork::new(config.clone(), Box::new(Arc::clone(&source)), precision)
                    .unwrap();
            assert_eq!(network.map(&image).unwrap(), map, "{precision}");
            assert_eq!(source.packed.failure(), None);
            source.packed.counts()
        };
        let ([none, kept], [found, more]) = (made(), made());
        let slow = precision == Precision::Fp32Winograd;
        assert!(none == 0 && (kept > 10) == slow, "{precision}: {none} {kept}");
        assert_eq!([found, more], [kept, 0], "{precision}: all of them are found again");
    }
}
