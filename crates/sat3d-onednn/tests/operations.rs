//! Every operation beside the plain loop, in every type, order and algorithm.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d_onednn::{
    After, Algorithm, BLOCK, Convolution, ConvolutionSpec, Element, Error, Instructions, Layout,
    Library, Memory, Order, Product, Session, Softmax, View, reorder,
};

fn library() -> Option<&'static Library> {
    Library::get().map_err(|why| println!("SKIPPED: {why}")).ok()
}

/// Repeatable values in [-1, 1).
fn values(seed: u64, count: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1_u32 << 23) as f32 - 1.0
    };
    (0..count).map(|_| next()).collect()
}

/// To the nearest 16-bit float, and back.
fn halved(value: f32) -> f32 {
    let bits = value.to_bits();
    f32::from_bits((bits + 0x7fff + (bits >> 16 & 1)) & 0xffff_0000)
}

/// From plain order (channels first) to a memory, and back.
fn place(order: Order, [channels, pixels]: [usize; 2], channel: usize, pixel: usize) -> usize {
    match order {
        Order::Pixels => pixel * channels + channel,
        Order::Blocks => (channel / BLOCK * pixels + pixel) * BLOCK + channel % BLOCK,
    }
}

struct Case {
    inputs: usize,
    outputs: usize,
    size: [usize; 2],
    kernel: [usize; 2],
    before: [usize; 2],
    after: [usize; 2],
}

const CASES: [Case; 4] = [
    Case { inputs: 32, outputs: 48, size: [7, 9], kernel: [3, 3], before: [1, 1], after: [1, 1] },
    Case { inputs: 16, outputs: 32, size: [6, 5], kernel: [2, 2], before: [1, 0], after: [0, 1] },
    Case { inputs: 32, outputs: 16, size: [5, 5], kernel: [1, 1], before: [0, 0], after: [0, 0] },
    Case { inputs: 16, outputs: 16, size: [20, 20], kernel: [3, 3], before: [0, 0], after: [0, 0] },
];

/// In double precision.
fn plain(case: &Case, input: &[f32], weights: &[f32], bias: &[f32]) -> Vec<f64> {
    let [height, width] = case.size;
    let across = |axis: usize| {
        case.size[axis] + case.before[axis] + case.after[axis] + 1 - case.kernel[axis]
    };
    let mut result = Vec::new();
    for (output, bias) in bias.iter().enumerate().take(case.outputs) {
        for row in 0..across(0) {
            for column in 0..across(1) {
                let mut sum = f64::from(*bias);
                for channel in 0..case.inputs {
                    for y in 0..case.kernel[0] {
                        for x in 0..case.kernel[1] {
                            let (from_y, from_x) = (row + y, column + x);
                            if from_y < case.before[0] || from_x < case.before[1] {
                                continue;
                            }
                            let (from_y, from_x) =
                                (from_y - case.before[0], from_x - case.before[1]);
                            if from_y < height && from_x < width {
                                let weight = ((output * case.inputs + channel) * case.kernel[0]
                                    + y)
                                    * case.kernel[1]
                                    + x;
                                sum += f64::from(weights[weight])
                                    * f64::from(
                                        input[(channel * height + from_y) * width + from_x],
                                    );
                            }
                        }
                    }
                }
                result.push(sum);
            }
        }
    }
    result
}

/// Convolves with the library, and gives how far from the plain loop it is, relative to the largest value.
fn apart(
    library: &'static Library,
    case: &Case,
    element: Element,
    order: Order,
    algorithm: Algorithm,
    sum: bool,
) -> Result<f64, Error> {
    let mut session = Session::new(library)?;
    let pixels = case.size[0] * case.size[1];
    let (mut input, mut weights) = (
        values(1, case.inputs * pixels),
        values(2, case.outputs * case.inputs * case.kernel[0] * case.kernel[1]),
    );
    if element == Element::Bf16 {
        input.iter_mut().chain(&mut weights).for_each(|value| *value = halved(*value));
    }
    let bias = values(3, case.outputs);
    let convolution = Convolution::new(
        library,
        &ConvolutionSpec {
            batch: 1,
            inputs: case.inputs,
            outputs: case.outputs,
            size: case.size,
            kernel: case.kernel,
            before: case.before,
            after: case.after,
            element,
            order,
            algorithm,
            sum,
        },
    )?;
    let packed = convolution.pack(&mut session, &weights)?;
    let mut source = Memory::new(convolution.source());
    for channel in 0..case.inputs {
        for pixel in 0..pixels {
            let value = input[channel * pixels + pixel];
            let at = place(order, [case.inputs, pixels], channel, pixel);
            match element {
                Element::F32 => source.floats_mut()[at] = value,
                Element::Bf16 => source.halves_mut()[at] = (value.to_bits() >> 16) as u16,
            }
        }
    }
    let mut result = Memory::new(convolution.result());
    if sum {
        result.floats_mut().fill(100.0);
    }
    convolution.run(&mut session, source.view(), &packed, &bias, &mut result)?;
    let wanted = plain(case, &input, &weights, &bias);
    let pixels = wanted.len() / case.outputs;
    let largest = wanted.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let mut worst = 0.0_f64;
    for (index, wanted) in wanted.iter().enumerate() {
        let at = place(order, [case.outputs, pixels], index / pixels, index % pixels);
        let found = f64::from(result.floats()[at]) - if sum { 100.0 } else { 0.0 };
        worst = worst.max((found - wanted).abs());
    }
    Ok(worst / largest)
}

#[test]
fn convolutions_are_those_of_the_plain_loop() {
    let Some(library) = library() else { return };
    for (index, case) in CASES.iter().enumerate() {
        for order in [Order::Pixels, Order::Blocks] {
            for element in [Element::F32, Element::Bf16] {
                let made = apart(library, case, element, order, Algorithm::Direct, false);
                match (made, element) {
                    // Products of 16-bit floats are exact in 32 bits; the sums are rounded as those of 32-bit ones.
                    (Ok(apart), _) => {
                        assert!(apart < 2e-6, "{index} {order:?} {element:?}: {apart}");
                    }
                    (Err(Error::Unimplemented { .. }), Element::Bf16) => {
                        println!("SKIPPED: no convolution of 16-bit floats on this processor");
                    }
                    (Err(error), _) => panic!("{index} {order:?} {element:?}: {error}"),
                }
            }
        }
        let apart =
            apart(library, case, Element::F32, Order::Pixels, Algorithm::Direct, true).unwrap();
        assert!(apart < 1e-5, "{index}, added: {apart}");
    }
}

#[test]
fn winograds_convolution_is_a_little_less_exact() {
    let Some(library) = library() else { return };
    if library.instructions() < Instructions::Avx512 {
        println!("SKIPPED: no Winograd convolutions on this processor");
        return;
    }
    for case in [&CASES[0], &CASES[3]] {
        for sum in [false, true] {
            let (element, order) = (Element::F32, Order::Blocks);
            let apart = apart(library, case, element, order, Algorithm::Winograd, sum).unwrap();
            assert!(apart < 2e-5, "{sum}: {apart}");
        }
    }
    // There is none for other kernels.
    let refused =
        apart(library, &CASES[1], Element::F32, Order::Blocks, Algorithm::Winograd, false);
    assert!(matches!(refused, Err(Error::Unimplemented { .. })), "{refused:?}");
}

#[test]
fn products_read_and_write_parts_of_larger_matrices() {
    let Some(library) = library() else { return };
    let mut session = Session::new(library).unwrap();
    // Two heads side by side in rows of 3 x 2 x 4 values: queries times keys.
    let (rows, heads, head) = (5, 2, 4);
    let row = 3 * heads * head;
    let all = values(7, rows * row);
    let whole = Layout::dense(library, &[rows, row], Element::F32).unwrap();
    let mut held = Memory::new(whole);
    held.floats_mut().copy_from_slice(&all);
    let left =
        Layout::strided(library, &[heads, rows, head], Element::F32, &[head, row, 1]).unwrap();
    let right =
        Layout::strided(library, &[heads, head, rows], Element::F32, &[head, 1, row]).unwrap();
    let result = Layout::dense(library, &[heads, rows, rows], Element::F32).unwrap();
    let product = Product::new(library, left, right, None, result, After::default()).unwrap();
    let mut logits = Memory::new(result);
    // Each part begins somewhere in the whole.
    let part = |layout, first: usize| View::part(layout, &all, first).unwrap();
    let (queries, keys) = (part(left, 0), part(right, heads * head));
    product.run(&mut session, queries, keys, &[], &mut logits).unwrap();
    for h in 0..heads {
        for i in 0..rows {
            for j in 0..rows {
                let wanted: f32 = (0..head)
                    .map(|k| {
                        all[i * row + h * head + k] * all[j * row + heads * head + h * head + k]
                    })
                    .sum();
                let found = logits.floats()[(h * rows + i) * rows + j];
                assert!((found - wanted).abs() < 1e-6, "{h} {i} {j}: {found}, {wanted}");
            }
        }
    }
    let softmax = Softmax::new(library, result, 3).unwrap();
    let mut shares = Memory::new(result);
    softmax.run(&mut session, logits.view(), &mut shares).unwrap();
    for (row, logits) in shares.floats().chunks(rows).zip(logits.floats().chunks(rows)) {
        let sum: f32 = logits.iter().map(|logit| logit.exp()).sum();
        for (share, logit) in row.iter().zip(logits) {
            assert!((share - logit.exp() / sum).abs() < 1e-6);
        }
    }
    assert!(View::part(left, &all, all.len() - 1).is_err());
}

#[test]
fn a_dense_layer_takes_bias_gelu_and_sum_along() {
    let Some(library) = library() else { return };
    let mut session = Session::new(library).unwrap();
    let (rows, inputs, outputs) = (6, 32, 48);
    let (left, stored, bias) =
        (values(1, rows * inputs), values(2, outputs * inputs), values(3, outputs));
    let source = Layout::dense(library, &[rows, inputs], Element::F32).unwrap();
    let result = Layout::dense(library, &[rows, outputs], Element::F32).unwrap();
    // Weights are stored as outputs x inputs.
    let turned = Layout::strided(library, &[inputs, outputs], Element::F32, &[1, inputs]).unwrap();
    for after in
        [After::default(), After { gelu: true, sum: false }, After { gelu: false, sum: true }]
    {
        let shape = (inputs, outputs, Element::F32);
        let layer = Product::packed(library, source, shape, result, after).unwrap();
        let packed = layer.pack(&mut session, View::of(turned, &stored).unwrap()).unwrap();
        let mut found = Memory::new(result);
        found.floats_mut().fill(2.0);
        let input = View::of(source, &left).unwrap();
        layer.run(&mut session, input, packed.view(), &bias, &mut found).unwrap();
        for row in 0..rows {
            for output in 0..outputs {
                let sum: f64 = (0..inputs)
                    .map(|k| {
                        f64::from(left[row * inputs + k]) * f64::from(stored[output * inputs + k])
                    })
                    .sum();
                let sum = sum + f64::from(bias[output]);
                // Gauss' error function by its series, which converges quickly for |x| < 6.
                let erf = |x: f64| {
                    let mut term = x;
                    let mut total = x;
                    for n in 1..200 {
                        term *= -x * x / f64::from(n);
                        total += term / f64::from(2 * n + 1);
                    }
                    total * 2.0 / std::f64::consts::PI.sqrt()
                };
                let wanted = if after.gelu {
                    0.5 * sum * (1.0 + erf(sum * std::f64::consts::FRAC_1_SQRT_2))
                } else if after.sum {
                    sum + 2.0
                } else {
                    sum
                };
                let found = f64::from(found.floats()[row * outputs + output]);
                assert!((found - wanted).abs() < 5e-6, "{after:?}: {found}, {wanted}");
            }
        }
    }
}

#[test]
fn a_memory_of_another_layout_is_refused_before_the_library_sees_it() {
    let Some(library) = library() else { return };
    let mut session = Session::new(library).unwrap();
    let small = Layout::dense(library, &[2, 2], Element::F32).unwrap();
    let large = Layout::dense(library, &[4, 4], Element::F32).unwrap();
    let product = Product::new(library, small, small, None, small, After::default()).unwrap();
    let (four, sixteen) = (values(1, 4), values(2, 16));
    let (fits, wide) = (View::of(small, &four).unwrap(), View::of(large, &sixteen).unwrap());
    let mut result = Memory::new(small);
    let error = product.run(&mut session, wide, fits, &[], &mut result).unwrap_err();
    assert_eq!(
        error.to_string(),
        "oneDNN: the left side of product of matrices has another layout than it was made for"
    );
    assert!(product.run(&mut session, fits, wide, &[], &mut result).is_err());
    assert!(product.run(&mut session, fits, fits, &[], &mut Memory::new(large)).is_err());
    assert!(product.run(&mut session, fits, fits, &four, &mut result).is_err());
    assert!(product.run(&mut session, fits, fits, &[], &mut result).is_ok());
    assert!(View::of(small, &sixteen).is_err());
    // Blocks with a rest are refused, and the same number of channels in the other order is not.
    assert!(Layout::map(library, [1, 8, 2, 2], Element::F32, Order::Blocks).is_err());
    assert!(Layout::map(library, [1, 8, 2, 2], Element::F32, Order::Pixels).is_ok());
}

#[test]
fn values_change_order_and_type() {
    let Some(library) = library() else { return };
    let mut session = Session::new(library).unwrap();
    let plain = values(5, 32 * 6);
    let dims = [1, 32, 2, 3];
    let pixels = Layout::map(library, dims, Element::F32, Order::Pixels).unwrap();
    let blocks = Layout::map(library, dims, Element::F32, Order::Blocks).unwrap();
    let mut there = Memory::new(blocks);
    reorder(&mut session, View::of(pixels, &plain).unwrap(), &mut there).unwrap();
    for channel in 0..32 {
        for pixel in 0..6 {
            let found = there.floats()[place(Order::Blocks, [32, 6], channel, pixel)];
            assert_eq!(found, plain[place(Order::Pixels, [32, 6], channel, pixel)]);
        }
    }
    let mut halves = Memory::new(Layout::map(library, dims, Element::Bf16, Order::Pixels).unwrap());
    match reorder(&mut session, View::of(pixels, &plain).unwrap(), &mut halves) {
        Ok(()) => {
            for (half, value) in halves.halves().iter().zip(&plain) {
                assert_eq!(f32::from_bits(u32::from(*half) << 16), halved(*value));
            }
        }
        Err(why) => println!("SKIPPED: {why}"),
    }
}
