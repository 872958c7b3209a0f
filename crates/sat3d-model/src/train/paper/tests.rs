use super::*;
use crate::Model;
use crate::network::Device;
use crate::preprocess::Image8;
use crate::random::Draw;
use crate::render::RenderOptions;
use crate::tensor::Grid;
use crate::train::example::Street;
use crate::train::optimiser::Named;
use crate::train::rays::ViewSettings;
use crate::weights::rule::{RuleWeights, tiny_overrides};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

const TINY: &str = include_str!("../../../fixtures/tiny/model/config.json");

/// The small network with a map of 40 x 40: a step takes a part of a second.
fn smaller() -> String {
    // White space of the file, once only.
    let flat: String = TINY.split_whitespace().collect();
    let smaller = flat.replace("\"ch_mult\":[1,1,1,1,1]", "\"ch_mult\":[1,1]");
    assert_ne!(smaller, flat);
    smaller
}

fn settings() -> PaperSettings {
    let release = PaperSettings::release();
    let mut weights = release.weights;
    for view in [&mut weights.satellite, &mut weights.panorama, &mut weights.perspective] {
        (view.l1, view.perceptual) = (1.0, 0.0);
    }
    weights.raw_view.perceptual = 0.0;
    PaperSettings {
        seed: 3,
        discriminator_channels: 16,
        views: ViewSettings {
            ortho_grid: 24,
            ortho_window: 16,
            panorama_width: 32,
            panorama_height: 8,
            perspective: 16,
            coarse_samples: 8,
            fine_samples: 4,
            ..ViewSettings::release()
        },
        weights,
        gravity_points: 50,
        ..release
    }
}

fn source(config: &str) -> RuleWeights {
    RuleWeights::new(&Config::from_json(config).expect("a config"), tiny_overrides())
}

fn learner(settings: PaperSettings) -> PaperLearner {
    let config = smaller();
    PaperLearner::new(&config, &source(&config), Device::Cpu, settings).expect("a learner")
}

fn noise(seed: u64, width: usize, height: usize, channels: usize) -> Image8 {
    let mut draw = Draw::new(&[seed]);
    let data = (0..width * height * channels).map(|_| draw.index(256) as u8).collect();
    Image8 { width, height, channels, data }
}

fn example(seed: u64) -> Example {
    let sky = (0..64 * 32).map(|pixel| if pixel < 64 * 14 { 255 } else { 0 }).collect();
    let mut draw = Draw::new(&[seed, 1]);
    Example {
        name: format!("example {seed}"),
        satellite: noise(seed, 32, 32, 3),
        truth: None,
        street: Some(Street {
            panorama: noise(seed + 100, 64, 32, 3),
            sky: Image8 { width: 64, height: 32, channels: 1, data: sky },
            position: [0.1, -0.2, -0.85],
        }),
        depth: Some(Grid::new(1, 24, 24, (0..576).map(|_| draw.unit() as f32).collect())),
    }
}

fn names(outcome: &Outcome) -> Vec<&'static str> {
    match outcome {
        Outcome::Stepped(terms) => terms.iter().map(|term| term.name).collect(),
        Outcome::Skipped(why) => panic!("skipped: {why}"),
    }
}

fn part<'a>(state: &'a [NamedTensor], prefix: &str) -> Vec<&'a NamedTensor> {
    state.iter().filter(|tensor| tensor.name.starts_with(prefix)).collect()
}

#[test]
fn generator_and_discriminators_take_turns() {
    let mut learner = learner(settings());
    let states = |learner: &PaperLearner| learner.state().expect("a state");
    let start = states(&learner);
    let of_generator = learner.step(0, &[example(1), example(2)]).expect("a step");
    let wanted = [
        "total",
        "satellite",
        "ortho_opacity",
        "depth",
        "panorama",
        "panorama.raw",
        "opacity",
        "sky_colour",
        "mean_sky_colour",
        "perspective",
        "perspective.raw",
        "adversarial.satellite",
        "adversarial.panorama",
        "adversarial.perspective",
        "gravity",
    ];
    assert_eq!(names(&of_generator), wanted);
    let Outcome::Stepped(terms) = &of_generator else { panic!("{of_generator:?}") };
    let sum: f32 = terms[1..].iter().map(|term| term.value).sum();
    assert!((sum - terms[0].value).abs() < 1e-4 * sum, "{terms:?}");
    let between = states(&learner);
    let of_critics = learner.step(1, &[example(3)]).expect("a step");
    let wanted =
        ["total", "discriminator.satellite", "discriminator.panorama", "discriminator.perspective"];
    assert_eq!(names(&of_critics), wanted);
    let end = states(&learner);
    for (prefix, first, second) in [
        ("weights/", true, false),
        ("discriminators/", false, true),
        ("power-iterations/", false, true),
    ] {
        assert_eq!(part(&start, prefix) != part(&between, prefix), first, "{prefix}");
        assert_eq!(part(&between, prefix) != part(&end, prefix), second, "{prefix}");
    }
    // Every trained part moves.
    for prefix in [
        "unet_model.decoder.conv_in",
        "mlp.net0",
        "mlp.style_squ",
        "sky_mapping",
        "sky_decoder",
        "sr_module",
    ] {
        let prefix = format!("weights/{prefix}");
        assert!(!part(&start, &prefix).is_empty());
        assert_ne!(part(&start, &prefix), part(&between, &prefix), "{prefix}");
    }
    assert!(part(&start, "weights/unet_model.dino_model").is_empty(), "the encoder is frozen");
}

#[test]
fn a_resumed_run_is_the_uninterrupted_one() {
    let batch = |step: u64| vec![example(step), example(step + 50)];
    let run = |learner: &mut PaperLearner, steps: std::ops::Range<u64>| {
        for step in steps {
            names(&learner.step(step, &batch(step)).expect("a step"));
        }
        learner.state().expect("a state")
    };
    let mut whole = learner(settings());
    let mut stopped = Vec::new();
    for step in 0..3 {
        stopped.push(run(&mut whole, step..step + 1));
    }
    let end = run(&mut whole, 3..4);
    // After a step of the generator, and after one of the discriminators.
    for (steps, state) in [(1, &stopped[0]), (2, &stopped[1])] {
        let mut resumed = learner(settings());
        resumed.restore(state).expect("a state of this model");
        assert_eq!(&resumed.state().expect("a state"), state);
        let found = run(&mut resumed, steps..4);
        assert_eq!(found.len(), end.len());
        for (found, wanted) in found.iter().zip(&end) {
            assert_eq!(found.name, wanted.name);
            let bits = |tensor: &NamedTensor| -> Vec<u32> {
                tensor.values.iter().map(|value| value.to_bits()).collect()
            };
            assert_eq!(bits(found), bits(wanted), "{}", found.name);
        }
    }
}

#[test]
fn a_state_of_another_model_is_refused_and_changes_nothing() {
    let mut learner = learner(settings());
    learner.step(0, &[example(1)]).expect("a step");
    let state = learner.state().expect("a state");
    let change = |of: &dyn Fn(&mut Vec<NamedTensor>)| {
        let mut state = state.clone();
        of(&mut state);
        state
    };
    let first = state.iter().position(|t| t.name.starts_with("weights/mlp.net0.weight"));
    let first = first.expect("a weight");
    let wrong = [
        change(&|state| drop(state.remove(first))),
        change(&|state| state.push(NamedTensor { name: "odd".into(), ..state[0].clone() })),
        change(&|state| state.push(state[0].clone())),
        change(&|state| state[first].shape.reverse()),
        change(&|state| state.retain(|t| !t.name.starts_with("power-iterations/panorama"))),
        change(&|state| state.retain(|t| !t.name.starts_with("average/mlp"))),
        change(&|state| state[first].values.truncate(1)),
        Vec::new(),
    ];
    for wrong in wrong {
        let error = learner.restore(&wrong).expect_err("another model's");
        assert!(matches!(error, TrainError::State(_)), "{error}");
        assert_eq!(learner.state().expect("a state"), state);
    }
}

#[test]
fn a_batch_that_is_not_finite_changes_nothing() {
    let mut settings = settings();
    settings.weights.satellite.perceptual = 1.0;
    settings.perceptual = PerceptualMeasure::Substitute;
    let kind = Arc::new(AtomicU8::new(0));
    let asked = Arc::clone(&kind);
    let distance = move |predicted: Tensor<4>, _: Tensor<4>| match asked.load(Ordering::SeqCst) {
        0 => predicted.abs().mean(),
        // A loss that is not finite, and a finite one whose gradient is not.
        1 => predicted.mean() * f32::NAN,
        _ => (predicted * 0.0).sqrt().mean(),
    };
    let config = smaller();
    let mut learner =
        PaperLearner::new(&config, &source(&config), Device::Cpu, settings).expect("a learner");
    learner.perceptual = Some(Box::new(distance));
    names(&learner.step(0, &[example(1)]).expect("a step"));
    names(&learner.step(1, &[example(1)]).expect("a step"));
    let before = learner.state().expect("a state");
    for (bad, word) in [(1, "satellite"), (2, "gradient")] {
        kind.store(bad, Ordering::SeqCst);
        let outcome = learner.step(2, &[example(2)]).expect("a step");
        assert!(matches!(&outcome, Outcome::Skipped(why) if why.contains(word)), "{outcome:?}");
        assert_eq!(learner.state().expect("a state"), before);
    }
    assert!(matches!(learner.step(2, &[]).expect("a step"), Outcome::Skipped(_)));
    kind.store(0, Ordering::SeqCst);
    names(&learner.step(2, &[example(2)]).expect("a step"));
}

#[test]
fn what_an_example_lacks_is_left_out() {
    let mut learner = learner(settings());
    let bare = Example { street: None, depth: None, ..example(1) };
    let of_bare = names(&learner.step(0, std::slice::from_ref(&bare)).expect("a step"));
    assert_eq!(
        of_bare,
        ["total", "satellite", "ortho_opacity", "adversarial.satellite", "gravity"]
    );
    // No panorama was rendered, and none is there: one discriminator learns.
    let critics = names(&learner.step(1, std::slice::from_ref(&bare)).expect("a step"));
    assert_eq!(critics, ["total", "discriminator.satellite"]);
    let mixed = learner.step(2, &[bare.clone(), example(2)]).expect("a step");
    assert!(names(&mixed).contains(&"panorama") && names(&mixed).contains(&"depth"));

    let mut off = settings();
    off.weights.adversarial = AdversarialWeights::all(0.0);
    off.weights.satellite.weight = 0.0;
    off.weights.gravity = 0.0;
    off.weights.ortho_opacity = 0.0;
    let mut learner = self::learner(off);
    // Nothing is left; and without discriminators every step is the generator's.
    assert!(matches!(learner.step(0, &[bare]).expect("a step"), Outcome::Skipped(_)));
    assert!(names(&learner.step(1, &[example(2)]).expect("a step")).contains(&"depth"));
}

#[test]
fn sky_and_super_resolution_can_be_left_out() {
    let plain = PaperSettings { sky: false, super_resolution: false, ..settings() };
    let mut learner = learner(plain);
    let terms = names(&learner.step(0, &[example(1)]).expect("a step"));
    assert!(terms.contains(&"panorama") && terms.contains(&"opacity"), "{terms:?}");
    assert!(!terms.iter().any(|name| name.contains("sky") || name.contains("raw")), "{terms:?}");
    names(&learner.step(1, &[example(1)]).expect("a step"));
    // The checkpoint is whole all the same.
    let exported = learner.export().expect("a model");
    let config = Config::from_json(&exported.config).expect("a config");
    let found: BTreeSet<String> = exported.model.iter().map(|t| t.name.clone()).collect();
    assert_eq!(found, keys(&config));
}

#[test]
fn the_papers_forms_and_a_plain_sampling_step_too() {
    let release = settings();
    let mut paper = PaperSettings { views: release.views.clone(), ..PaperSettings::paper() };
    let PaperSettings { seed, discriminator_channels, gravity_points, .. } = release;
    (paper.seed, paper.discriminator_channels) = (seed, discriminator_channels);
    paper.gravity_points = gravity_points;
    paper.views.fine_samples = 0;
    paper.views.jitter = false;
    let weights = &mut paper.weights;
    for view in [&mut weights.satellite, &mut weights.panorama, &mut weights.perspective] {
        view.perceptual = 0.0;
    }
    let mut learner = learner(paper);
    let terms = names(&learner.step(0, &[example(1)]).expect("a step"));
    assert!(terms.contains(&"sky_colour") && !terms.contains(&"panorama.raw"), "{terms:?}");
    names(&learner.step(1, &[example(2)]).expect("a step"));
}

/// Keys of a whole checkpoint.
fn keys(config: &Config) -> BTreeSet<String> {
    expected(config)
        .into_iter()
        .map(|spec| spec.key)
        .filter(|key| key != "point_representer.triplane_axes")
        .collect()
}

#[test]
fn an_exported_model_is_the_one_that_was_trained() {
    let mut still = settings();
    still.generator.learning_rate = 0.0;
    let config = smaller();
    let weights = source(&config);
    let mut learner = learner(still);
    names(&learner.step(0, &[example(1)]).expect("a step"));
    let exported = learner.export().expect("a model");
    let parsed = Config::from_json(&exported.config).expect("a config");
    for tensors in [&exported.model, &exported.average] {
        let found: BTreeSet<String> = tensors.iter().map(|t| t.name.clone()).collect();
        assert_eq!(found.len(), tensors.len());
        assert_eq!(found, keys(&parsed));
    }
    let dsm = |source: Box<dyn TensorSource>| {
        let model =
            Model::from_source(parsed.clone(), source, &Device::Cpu.into()).expect("a model");
        let scene = model.scene(&noise(1, 32, 32, 3), None, 32.24).expect("a scene");
        let heights = scene.dsm(16, &RenderOptions::default()).height;
        heights.iter().map(|height| height.to_bits()).collect::<Vec<_>>()
    };
    let wanted = dsm(Box::new(weights));
    assert_eq!(dsm(Box::new(Named::new(exported.model))), wanted);
    assert_eq!(dsm(Box::new(Named::new(exported.average))), wanted);
    assert!(wanted.iter().collect::<BTreeSet<_>>().len() > 100, "heights differ");
}

#[test]
fn the_loss_falls() {
    let mut settings = settings();
    settings.weights.adversarial = AdversarialWeights::all(0.0);
    settings.generator.learning_rate = 2e-3;
    settings.generator.beta1 = 0.9;
    settings.generator.beta2 = 0.999;
    settings.encoder_rescale = 1.0;
    let mut learner = learner(settings);
    let mut totals = Vec::new();
    for step in 0..16 {
        let Outcome::Stepped(terms) = learner.step(step, &[example(1)]).expect("a step") else {
            panic!("skipped")
        };
        totals.push(terms[0].value);
    }
    let mean = |part: &[f32]| part.iter().sum::<f32>() / part.len() as f32;
    let (first, last) = (mean(&totals[..4]), mean(&totals[12..]));
    assert!(last < 0.98 * first, "{totals:?}");
}

#[test]
fn the_small_network_learns_likewise() {
    let sizes = MiniSettings {
        widths: [8, 8, 8],
        blocks: [1, 1, 1],
        attention: 1,
        heads: 2,
        channels: 4,
        hidden: 8,
        pad: 0.0,
    };
    let new = || PaperLearner::mini(&sizes, Device::Cpu, settings()).expect("a learner");
    let run = |learner: &mut PaperLearner<MiniMap>, steps: std::ops::Range<u64>| {
        for step in steps {
            names(&learner.step(step, &[example(1), example(2)]).expect("a step"));
        }
        learner.state().expect("a state")
    };
    let mut whole = new();
    let start = whole.state().expect("a state");
    let half = run(&mut whole, 0..2);
    let end = run(&mut whole, 2..4);
    for prefix in ["weights/unet.stem.norm.running_mean", "weights/unet.line", "weights/mlp.net0"] {
        assert!(!part(&start, prefix).is_empty(), "{prefix}");
        assert_ne!(part(&start, prefix), part(&half, prefix), "{prefix}");
    }
    let mut resumed = new();
    resumed.restore(&half).expect("a state of this model");
    assert!(run(&mut resumed, 2..4) == end, "a resumed run is another one");
    // The depth label reaches the plane through the soft surface.
    let mut pulled = settings();
    pulled.weights.adversarial = AdversarialWeights::all(0.0);
    for term in [&mut pulled.weights.satellite, &mut pulled.weights.panorama] {
        term.weight = 0.0;
    }
    (pulled.weights.perspective.weight, pulled.weights.opacity) = (0.0, 0.0);
    (pulled.weights.ortho_opacity, pulled.weights.gravity) = (0.0, 0.0);
    (pulled.weights.sky_colour, pulled.weights.mean_sky_colour) = (0.0, 0.0);
    pulled.generator.learning_rate = 3e-3;
    (pulled.generator.beta1, pulled.generator.beta2) = (0.9, 0.999);
    let views = &mut pulled.views;
    (views.ortho_window, views.coarse_samples, views.fine_samples) = (24, 24, 0);
    views.jitter = false;
    // A block in the middle, in the picture and in the label.
    let inside = |place: usize, side: usize| {
        let middle = |at: usize| (side / 4..3 * side / 4).contains(&at);
        middle(place / side) && middle(place % side)
    };
    let mut block = example(1);
    let label = (0..576).map(|place| if inside(place, 24) { 0.9 } else { 0.1 }).collect();
    block.depth = Some(Grid::new(1, 24, 24, label));
    for (place, pixel) in block.satellite.data.chunks_exact_mut(3).enumerate() {
        pixel.fill(if inside(place, 32) { 220 } else { 60 });
    }
    let mut learner = PaperLearner::mini(&sizes, Device::Cpu, pulled).expect("a learner");
    let mut totals = Vec::new();
    for step in 0..40 {
        let outcome = learner.step(step, std::slice::from_ref(&block)).expect("a step");
        assert_eq!(names(&outcome), ["total", "depth"]);
        let Outcome::Stepped(terms) = outcome else { panic!("skipped") };
        totals.push(terms[0].value);
    }
    assert!(totals[39] < 0.7 * totals[0], "{totals:?}");
    let Exported { config, average, .. } = whole.export().expect("a model");
    let config = Config::from_json(&config).expect("a config");
    let model = Model::from_source(config, Box::new(Named::new(average)), &Device::Cpu.into());
    let scene = model.expect("a model").scene(&noise(1, 32, 32, 3), None, 32.24).expect("a scene");
    let heights = scene.dsm(8, &RenderOptions::default()).height;
    assert!(heights.iter().all(|height| (0.0..0.2).contains(height)), "{heights:?}");
}

#[test]
fn settings_are_plain_values_and_nonsense_is_named() {
    for settings in [PaperSettings::release(), PaperSettings::paper(), settings()] {
        let text = serde_json::to_string(&settings).expect("a text");
        assert_eq!(serde_json::from_str::<PaperSettings>(&text).expect("settings"), settings);
    }
    let measured = |perceptual| PaperSettings { perceptual, ..PaperSettings::release() };
    assert!(measured(PerceptualMeasure::Substitute).check().is_ok());
    let error = PaperSettings::release().check().expect_err("no distance").to_string();
    assert!(error.contains("weights.satellite") && error.contains("perceptual"), "{error}");
    // Measures are named as in a recipe, and one whose files are absent is an error.
    let lpips = PerceptualMeasure::Lpips(vec!["vgg.safetensors".into()]);
    assert_eq!(serde_json::to_string(&lpips).expect("a text"), r#"{"lpips":["vgg.safetensors"]}"#);
    let config = smaller();
    let opened = PaperLearner::new(&config, &source(&config), Device::Cpu, measured(lpips.clone()));
    assert!(opened.expect_err("no such file").to_string().contains("vgg.safetensors"));
    assert!(PaperSettings { perceptual: lpips, ..settings() }.check().is_err(), "8 rows");
    let mut wrong = [settings(), settings(), settings(), settings()];
    wrong[0].weights.depth = f64::NAN;
    wrong[1].views.coarse_samples = 1;
    wrong[2].encoder_rescale = 0.5;
    wrong[3].weights.adversarial.panorama = -1.0;
    for wrong in wrong {
        let error = wrong.check().expect_err("nonsense");
        assert!(matches!(error, TrainError::Setting { .. }), "{error}");
    }
}
