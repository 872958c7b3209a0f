use super::*;
use crate::preprocess::Image8;
use crate::random::Draw;
use crate::tensor::Grid;
use crate::train::example::Truth;

const SIDE: usize = 256;

fn mini() -> MiniSettings {
    MiniSettings {
        widths: [8, 8, 8],
        blocks: [1, 1, 1],
        attention: 1,
        heads: 2,
        channels: 4,
        hidden: 4,
        ..MiniSettings::default()
    }
}

fn learner(settings: HeightSettings) -> HeightLearner {
    HeightLearner::new(mini(), settings, Device::Cpu, 5).expect("a learner")
}

fn settings() -> HeightSettings {
    HeightSettings { steps: 60, warm_up: 4, ..HeightSettings::default() }
}

/// Bright boxes on dark ground that slopes, the brighter the higher.
fn example(seed: u64) -> Example {
    let draw = &mut Draw::new(&[seed]);
    let mut rgb = vec![60_u8; 3 * SIDE * SIDE];
    let ground: Vec<f32> = (0..SIDE * SIDE).map(|i| 0.01 * ((i % SIDE) as f32 - 128.0)).collect();
    let mut surface = ground.clone();
    let mut classes = vec![Class::Ground; SIDE * SIDE];
    for _ in 0..6 {
        let (x, y) = (draw.index(SIDE - 64), draw.index(SIDE - 64));
        let height = 3 + draw.index(12);
        for row in y..y + 64 {
            for i in row * SIDE + x..row * SIDE + x + 64 {
                rgb[3 * i..3 * i + 3].fill((90 + 10 * height) as u8);
                surface[i] = ground[i] + height as f32;
                classes[i] = Class::Building;
            }
        }
    }
    let grid = |heights| Grid::new(1, SIDE, SIDE, heights);
    Example {
        name: format!("boxes {seed}"),
        satellite: Image8 { width: SIDE, height: SIDE, channels: 3, data: rgb },
        depth: None,
        truth: Some(Truth { surface: grid(surface), ground: grid(ground), classes }),
        street: None,
    }
}

fn terms(outcome: Outcome) -> Vec<Term> {
    match outcome {
        Outcome::Stepped(terms) => terms,
        Outcome::Skipped(why) => panic!("skipped: {why}"),
    }
}

#[test]
fn boxes_are_learnt() {
    let mut learner = learner(settings());
    let batch = [example(1), example(2)];
    let mut losses = Vec::new();
    for step in 0..60 {
        let terms = terms(learner.step(step, &batch).expect("a step"));
        let names: Vec<&str> = terms.iter().map(|term| term.name).collect();
        assert_eq!(names, ["total", "logarithm", "metric", "slope", "classes", "colour"]);
        let sum: f32 = terms[1..].iter().map(|term| term.value).sum();
        assert!((sum - terms[0].value).abs() < 1e-5 * sum);
        losses.push(terms[1].value);
    }
    assert!(losses[59] < 0.5 * losses[0], "{losses:?}");
}

#[test]
fn steps_do_not_depend_on_threads_and_go_on_from_a_state() {
    let batches = [[example(1), example(2), example(3)], [example(4), example(5), example(6)]];
    let names = |learner: &HeightLearner| learner.state().expect("a state");
    let (mut first, mut second) = (learner(settings()), learner(settings()));
    for (step, batch) in (0..).zip(&batches) {
        first.step(step, batch).expect("a step");
    }
    second.step(0, &batches[0]).expect("a step");
    let mut resumed = learner(HeightSettings { slope: 0.05, ..settings() });
    resumed.restore(&names(&second)).expect("a state of its own");
    resumed.step(1, &batches[1]).expect("a step");
    assert_eq!(names(&first), names(&resumed));
    assert_ne!(names(&first), names(&second));
}

#[test]
fn a_training_begins_with_the_weights_of_another() {
    let mut first = learner(settings());
    first.step(0, &[example(1), example(2)]).expect("a step");
    let state = first.state().expect("a state");
    let mut second = HeightLearner::new(mini(), settings(), Device::Cpu, 6).expect("a learner");
    assert_ne!(first.weights(), second.weights());
    second.begin_with(&state).expect("weights of the same size");
    assert_eq!(first.weights(), second.weights());
    // Nothing else is taken over: the moments of the optimiser begin at nothing.
    second.step(0, &[example(1), example(2)]).expect("a step");
    first.step(0, &[example(1), example(2)]).expect("a step");
    assert_ne!(first.weights(), second.weights());

    let wider = MiniSettings { widths: [8, 8, 16], ..mini() };
    let mut other = HeightLearner::new(wider, settings(), Device::Cpu, 5).expect("a learner");
    let before = other.weights();
    let error = other.begin_with(&state).expect_err("another size").to_string();
    assert!(error.contains("unet.") && error.contains('8') && error.contains("16"), "{error}");
    assert_eq!(other.weights(), before);
    let error = other.begin_with(&state[..0]).expect_err("nothing in it").to_string();
    assert!(error.contains("no weights"), "{error}");
}

#[test]
fn a_training_goes_on_from_a_finished_model() {
    let mut first = learner(settings());
    let images: Vec<Example> = (1..=2).map(example).collect();
    for step in 0..3 {
        first.step(step, &images).expect("a step");
    }
    let exported = first.export().expect("a model");
    let config = Config::from_json(&exported.config).expect("a config");
    let source = Named::new(exported.model.clone());

    let mut second = HeightLearner::new(mini(), settings(), Device::Cpu, 6).expect("a learner");
    second.begin_with_model(&config, &source).expect("a model of the same size");
    // It is the same model: exported again it has the same tensors, and it sees the same heights.
    assert_eq!(second.export().expect("a model").model, exported.model);
    let heights = |learner: &HeightLearner| {
        let images = Tensor::ones([1, 3, SIDE, SIDE], &learner.device) * 0.3;
        let planes = learner.network.planes(images, Mode::Evaluate);
        values(&planes.narrow(1, 0, 1).without_autodiff())
    };
    let (before, after) = (heights(&first), heights(&second));
    let apart = before.iter().zip(&after).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let size = before.iter().map(|value| value.abs()).fold(0.0, f32::max);
    assert!(apart < 1e-4 * size, "{apart} of {size}");

    // It learns without norms, and is stored and gone on with as any other.
    let stepped = terms(second.step(0, &images).expect("a step"));
    assert!(stepped.iter().all(|term| term.value.is_finite()), "{stepped:?}");
    let state = second.state().expect("a state");
    assert!(state.iter().all(|tensor| !tensor.name.contains("norm.")));
    let mut third = HeightLearner::new(mini(), settings(), Device::Cpu, 7).expect("a learner");
    third.restore(&state).expect("a state without norms");
    assert_eq!(third.state().expect("a state"), state);
    second.step(1, &images).expect("a step");
    third.step(1, &images).expect("a step");
    assert_eq!(third.state().expect("a state"), second.state().expect("a state"));
    assert_ne!(second.export().expect("a model").model, exported.model);

    let wider = MiniSettings { widths: [8, 8, 16], ..mini() };
    let mut other = HeightLearner::new(wider, settings(), Device::Cpu, 5).expect("a learner");
    let error = other.begin_with_model(&config, &source).expect_err("another size").to_string();
    assert!(error.contains("[8, 8, 8]") && error.contains("[8, 8, 16]"), "{error}");
    let error = other.begin_with_model(&Config::released(), &source).expect_err("another");
    assert!(error.to_string().contains("not a small network"), "{error}");
}

#[test]
fn parameters_of_its_own_learn_and_leave_the_originals_alone() {
    let learner = learner(settings());
    let copy = own(learner.network.clone());
    assert_eq!(named_parameters("", &copy), named_parameters("", &learner.network));
    let gradients = |network: &UNet, of: &UNet| {
        let images = Tensor::ones([1, 3, SIDE, SIDE], &learner.device);
        let mut statistics = Statistics::new();
        let planes = network.planes(images, Mode::Train(&mut statistics));
        let list = ParameterGradients::of("unet", of, &planes.sum().backward());
        (list.finite(), list.count())
    };
    // Running statistics do not learn, in a copy either.
    let (_, learning) = gradients(&learner.network, &learner.network);
    assert!(learning > 0);
    assert_eq!(gradients(&copy, &copy), (true, learning));
    assert_eq!(gradients(&copy, &learner.network).1, 0);
}

#[test]
fn unknown_heights_count_for_nothing() {
    let hidden = |value: f32| {
        let mut example = example(1);
        let truth = example.truth.as_mut().expect("has heights");
        // Whole texels, and one pixel of another.
        for row in 0..SIDE {
            truth.surface.data[row * SIDE..row * SIDE + 100].fill(f32::NAN);
        }
        truth.surface.data[SIDE - 1] = f32::NAN;
        // The other three pixels of it say nothing either.
        truth.surface.data[SIDE - 2] = value;
        example
    };
    let step = |example| {
        let mut learner = learner(HeightSettings { slope: 0.0, ..settings() });
        let logged = terms(learner.step(0, &[example]).expect("a step"));
        assert!(logged.iter().all(|term| term.value.is_finite()), "{logged:?}");
        (logged, learner.state().expect("a state"))
    };
    assert_eq!(step(hidden(5.0)), step(hidden(5000.0)));
    // Nothing known at all: the other terms are still learnt from.
    let mut blind = example(1);
    blind.truth.as_mut().expect("has heights").surface.data.fill(f32::NAN);
    let (logged, _) = step(blind);
    assert_eq!(logged[1].value, 0.0);
}

#[test]
fn a_bad_batch_leaves_the_weights_alone() {
    let mut learner = learner(settings());
    let before = learner.state().expect("a state");
    let mut bad = example(1);
    bad.truth.as_mut().expect("has heights").ground.data.fill(f32::INFINITY);
    bad.truth.as_mut().expect("has heights").surface.data.fill(3e38);
    let outcome = learner.step(0, &[example(2), bad]).expect("a step");
    // Such heights are unknown; heights that are finite and absurd overflow the metric term.
    assert!(matches!(outcome, Outcome::Stepped(_)), "{outcome:?}");
    let mut learner = self::learner(settings());
    let mut bad = example(1);
    bad.truth.as_mut().expect("has heights").surface.data.fill(8e37);
    let outcome = learner.step(0, &[bad]).expect("a step");
    assert!(matches!(&outcome, Outcome::Skipped(why) if why.contains("loss of")), "{outcome:?}");
    assert_eq!(learner.state().expect("a state"), before);
    let mut none = example(1);
    none.truth = None;
    let error = learner.step(0, &[none]).expect_err("no heights").to_string();
    assert!(error.contains("boxes 1") && error.contains("true heights"), "{error}");
    let error =
        HeightLearner::new(mini(), HeightSettings { steps: 0, ..settings() }, Device::Cpu, 1);
    assert!(error.is_err());
}
