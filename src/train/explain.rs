//! The plan of a training: what `--explain` prints.

use super::factory::parameters;
use super::run::Prepared;
use super::settings::{DataSource, ModelKind, ObjectiveKind, Symmetries};
use crate::plan::{Plan, Step};
use serde_json::Map;

/// What a training does, step by step.
#[must_use]
pub fn plan(prepared: &Prepared) -> Plan {
    let settings = &prepared.settings;
    let run = &settings.run;
    let mut steps = data_steps(prepared);
    steps.push(model_step(prepared));
    // Checked when the settings were read.
    for term in settings.terms().unwrap_or_default() {
        let on = term.weight > 0.0 && term.lacks.is_none();
        let reason = match (term.lacks, term.weight > 0.0) {
            (_, false) => "its weight is 0",
            (Some(lacks), true) => lacks,
            (None, true) => "the data hold what it needs",
        };
        let cause = format!("objective.{}", settings.objective.kind.name());
        steps.push(Step::exact(
            &format!("loss.{}", term.name.trim_start_matches("weights.")),
            on,
            format!("weight {}", term.weight),
            ["in every step", &cause, reason],
        ));
    }
    let rate =
        settings.objective().map_or_else(|_| String::new(), |objective| objective.optimiser());
    if settings.objective.kind == ObjectiveKind::Paper {
        let given = !settings.objective.lpips.is_empty();
        let (form, reason) = match given {
            true => ("LPIPS (VGG16)", "the weights that objective.lpips names"),
            false => (
                "substitute for LPIPS: structure and edges, no learned weights",
                "objective.lpips names no weights; results do not compare with those that used LPIPS",
            ),
        };
        let cost = "two passes through VGG16 for each picture, where given";
        steps.push(Step::exact(
            "perceptual",
            true,
            form.to_owned(),
            [cost, "objective.lpips", reason],
        ));
    }
    let images = run.steps * run.batch as u64;
    steps.push(Step::exact(
        "optimise",
        true,
        format!("{} steps of {}, {rate}", run.steps, run.batch),
        [
            &format!("{images} examples, on {}", prepared.device),
            "run.steps, run.batch, seed",
            &format!("seed {}: the examples of a step depend on it and the step alone", run.seed),
        ],
    ));
    let kept =
        if run.keep == 0 { "all kept".to_owned() } else { format!("the last {} kept", run.keep) };
    steps.push(Step::exact(
        "checkpoint",
        true,
        format!("every {} steps, {kept}", run.checkpoint_every),
        [
            "weights, their average, and the optimiser's moments",
            "a run may be killed",
            "a second run goes on from the newest and ends with the same bytes",
        ],
    ));
    let held_out = settings.data.held_out;
    steps.push(Step::exact(
        "held-out",
        run.preview_every > 0 && held_out > 0,
        format!("{held_out} examples every {} steps", run.preview_every),
        ["one DSM each", "run.preview_every, data.held_out", "pictures and errors in the log"],
    ));
    steps.push(Step::exact(
        "time-limit",
        run.minutes.is_some(),
        run.minutes.map_or_else(|| "none".to_owned(), |minutes| format!("{minutes} min")),
        ["none", "run.minutes", "ends with a checkpoint; another run goes on"],
    ));
    Plan {
        command: "train".into(),
        tolerance_m: 0.0,
        parameters: prepared.identity.as_object().cloned().unwrap_or_else(Map::new),
        steps,
    }
}

fn model_step(prepared: &Prepared) -> Step {
    let model = &prepared.settings.model;
    let kind = match model.kind {
        ModelKind::Mini => "mini",
        ModelKind::Reference => "reference",
    };
    let size = parameters(&prepared.settings).map_or_else(String::new, |count| {
        format!(", {:.2} million parameters", count as f64 / 1e6)
    });
    let config = match &model.config {
        Some(file) => format!("config {}", file.display()),
        None => "built-in config".to_owned(),
    };
    let start = match &model.start {
        Some(folder) => format!("begins with {}", folder.display()),
        None => "begins with random weights".to_owned(),
    };
    Step::exact(
        "model",
        true,
        format!("{kind}{size}"),
        ["one pass forward and back per step", &config, &start],
    )
}

fn data_steps(prepared: &Prepared) -> Vec<Step> {
    let data = &prepared.settings.data;
    let threads = format!("{} threads, {} batches ahead", data.threads(), data.ahead);
    let mut steps = vec![Step::exact(
        "data",
        true,
        prepared.source.describe(),
        [&threads, "data.source", "what is missing or broken is skipped, counted, and replaced"],
    )];
    match (data.source, &data.vigor) {
        (DataSource::Vigor, Some(vigor)) => {
            let street = format!("panoramas, sky masks in {}/", vigor.sky_masks);
            let reason = if vigor.street {
                "masks of the panorama's size"
            } else {
                "data.vigor.street is off"
            };
            steps.push(Step::exact(
                "street",
                vigor.street,
                street,
                ["one JPEG each", "data.vigor.street", reason],
            ));
            let depth = !vigor.depth.is_empty();
            let reason = if depth {
                "where a label is missing, its example goes without"
            } else {
                "data.vigor.depth is empty"
            };
            let form =
                if depth { format!("labels in {}/", vigor.depth) } else { "none".to_owned() };
            steps.push(Step::exact(
                "depth",
                depth,
                form,
                ["one PNG each", "data.vigor.depth", reason],
            ));
        }
        _ => {
            let simulated = &data.simulated;
            let crops = match simulated.symmetries {
                Symmetries::None => "random crops",
                Symmetries::Mirror => "random crops, mirrored east to west",
                Symmetries::Square => "random crops, turned and mirrored",
            };
            steps.push(Step::exact(
                "augment",
                simulated.symmetries != Symmetries::None || simulated.colour > 0.0,
                format!("{crops}, colours moved by {}", simulated.colour),
                ["none to speak of", "data.simulated", "keyed by seed and draw"],
            ));
        }
    }
    steps
}
