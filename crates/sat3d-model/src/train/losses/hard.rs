//! Every loss on what it was not made for: values and gradients must stay finite.

use super::adversarial::Adversarial;
use super::depth::{Depth, satellite_depth};
use super::gravity::{Gravity, gravity};
use super::height::{Height, class_entropy, height};
use super::perceptual::{Perceptual, Substitute};
use super::photometric::{Photometric, half_size, photometric};
use super::sky::{Opacity, SkyColour, mean_sky_colour, opacity, ortho_opacity, sky_colour};
use super::testing::{narrow, scalar, uniform, values};
use burn::tensor::Tensor;

const SHAPE: [usize; 4] = [2, 3, 16, 16];
const COUNT: usize = 2 * 3 * 16 * 16;

type Loss = Box<dyn Fn(Tensor<4>, Tensor<4>) -> Tensor<1>>;

/// Channels `from..from + count` of a tensor.
fn channels(tensor: &Tensor<4>, from: usize, count: usize) -> Tensor<4> {
    tensor.clone().narrow(1, from, count)
}

/// One channel.
fn one(tensor: &Tensor<4>) -> Tensor<4> {
    channels(tensor, 0, 1)
}

/// Each loss as a function of a prediction and a target of `SHAPE`, and whether its target may be
/// unknown in places.
fn losses() -> Vec<(&'static str, bool, Loss)> {
    let mut list: Vec<(&'static str, bool, Loss)> = Vec::new();
    let mut add = |name, unknown, loss: Loss| list.push((name, unknown, loss));
    add("gravity", false, Box::new(|p, t| gravity(t, p, &Gravity::release())));
    for form in [Depth::release(), Depth::paper()] {
        add("depth", true, Box::new(move |p, t| satellite_depth(one(&p), one(&t), &form).total));
    }
    for form in [Opacity::release(), Opacity::paper()] {
        add("opacity", true, Box::new(move |p, t| opacity(one(&p), one(&t), &form)));
        add("ortho opacity", true, Box::new(move |p, _| ortho_opacity(one(&p), &form)));
    }
    let sky = SkyColour::release();
    add("sky colour", true, Box::new(move |p, t| sky_colour(p, t.clone(), one(&t), &sky)));
    add("mean sky", true, Box::new(move |p, t| mean_sky_colour(p, t.clone(), one(&t), &sky)));
    for game in [Adversarial::release(), Adversarial::paper()] {
        add("generator", false, Box::new(move |p, _| game.generator(p)));
        add("discriminator", false, Box::new(move |p, t| game.discriminator(t, p)));
    }
    let measures = [
        Perceptual::Substitute(Substitute::default()),
        Perceptual::Lpips(Box::new(super::lpips::narrow_weights())),
    ];
    for measure in measures {
        let name = measure.name();
        let all = Photometric { l1: 1.0, l2: 1.0, perceptual: 1.0 };
        add(name, false, Box::new(move |p, t| photometric(p, t, &measure, &all)));
    }
    add("half size", false, Box::new(|p, t| (half_size(p) - half_size(t)).abs().sum()));
    add("height", true, Box::new(|p, t| height(one(&p), one(&t), &Height::default(), 1.0).total));
    add(
        "classes",
        true,
        Box::new(|p, t| {
            let known = t.clone().is_finite();
            let classes = one(&t.mask_fill(known.bool_not(), -1.0).clamp(-1.0, 9.0)).int();
            class_entropy(p, classes, &[1.0, 0.0, 2.0])
        }),
    );
    list
}

/// Constant depth, empty and full opacity, huge and tiny values of both signs, steps.
fn predictions() -> Vec<(String, Vec<f32>)> {
    let mut list: Vec<(String, Vec<f32>)> = [0.0, 1.0, -1.0, 0.5, 1e-30, 1e12, -1e12]
        .map(|value| (format!("all {value:e}"), vec![value; COUNT]))
        .to_vec();
    let mut spike = vec![0.25; COUNT];
    spike[300] = 1e6;
    list.push(("a spike".into(), spike));
    let board = (0..COUNT).map(|i| if (i + i / 16) % 2 == 0 { 1e6 } else { -1e6 });
    list.push(("a chessboard".into(), board.collect()));
    let noise = uniform(1, COUNT, 0.0, 1.0);
    list.push(("noise".into(), noise.iter().map(|v| *v as f32).collect()));
    let faint = noise.iter().map(|v| 0.5 + 1e-7 * *v as f32);
    list.push(("almost constant".into(), faint.collect()));
    list
}

/// Constants (no sky, all sky), noise; and, unknown: all, all but one pixel, one image.
fn targets() -> Vec<(&'static str, bool, Vec<f32>)> {
    let noise: Vec<f32> = uniform(2, COUNT, 0.0, 1.0).iter().map(|v| *v as f32).collect();
    let mut one_known = vec![f32::NAN; COUNT];
    one_known[37] = 1.0;
    let mut one_image = noise.clone();
    one_image[..COUNT / 2].fill(f32::NAN);
    vec![
        ("nought", false, vec![0.0; COUNT]),
        ("one", false, vec![1.0; COUNT]),
        ("huge", false, vec![1e12; COUNT]),
        ("noise", false, noise),
        ("nothing known", true, vec![f32::NAN; COUNT]),
        ("one pixel known", true, one_known),
        ("one image known", true, one_image),
    ]
}

#[test]
fn every_loss_is_finite_on_hard_inputs() {
    let mut failures = Vec::new();
    let mut cases = 0;
    for (name, may_be_unknown, loss) in losses() {
        for (target_name, unknown, target) in targets() {
            if unknown && !may_be_unknown {
                continue;
            }
            for (prediction_name, prediction) in predictions() {
                let leaf = narrow(&prediction, SHAPE).require_grad();
                let value = loss(leaf.clone(), narrow(&target, SHAPE));
                let gradients = value.backward();
                let slopes = leaf.grad(&gradients).map(values).unwrap_or_default();
                let finite = slopes.len() == COUNT && slopes.iter().all(|v| v.is_finite());
                let value = scalar(value);
                if !finite || !value.is_finite() {
                    let bad = slopes.iter().filter(|v| !v.is_finite()).count();
                    failures.push(format!(
                        "{name} of {prediction_name} against {target_name}: {value}, \
                         {bad} gradients of {}",
                        slopes.len()
                    ));
                }
                cases += 1;
            }
        }
    }
    assert!(failures.is_empty(), "{} of {cases}:\n{}", failures.len(), failures.join("\n"));
    assert!(cases > 900, "{cases}");
}
