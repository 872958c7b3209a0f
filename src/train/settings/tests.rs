//! Settings as people write them, and as they should not.

use super::*;
use crate::model::train::HeightSettings;
use serde_json::json;

fn parse(text: &str) -> Result<Settings, TrainingError> {
    Settings::parse(Path::new("/runs/a/train.toml"), text, &[])
}

fn refusal(text: &str) -> String {
    parse(text).expect_err(text).to_string()
}

#[test]
fn everything_has_a_default() {
    let settings = parse("").expect("parses");
    assert_eq!(settings.model.kind, ModelKind::Mini);
    assert_eq!(settings.objective.kind, ObjectiveKind::Heights);
    assert_eq!(settings.data.source, DataSource::Simulated);
    assert_eq!(settings.run, RunSettings::default());
    assert_eq!(settings.device().expect("a device"), Device::Cpu);
}

#[test]
fn tables_may_be_written_in_both_ways_and_paths_belong_to_the_file() {
    let text = "[data]\nsource = \"simulated\"\nsimulated = { scenes = 5, cache = \"../cache\" }\n\
                [run]\nminutes = 3\n[objective.heights]\noptimiser = { learning_rate = 2e-3 }\n";
    let settings = parse(text).expect("parses");
    assert_eq!(settings.data.simulated.scenes, 5);
    assert_eq!(settings.data.simulated.cache, Some("/runs/a/../cache".into()));
    assert_eq!(settings.run.minutes, Some(3.0));
    let Ok(Objective::Heights(heights)) = settings.objective() else { panic!("heights") };
    let default = HeightSettings::default();
    assert_eq!(
        (heights.optimiser.learning_rate, heights.optimiser.beta2),
        (2e-3, default.optimiser.beta2)
    );
    assert_eq!((heights.steps, heights.classes), (settings.run.steps, default.classes));
}

#[test]
fn what_is_wrong_is_named_with_its_place_and_what_is_served() {
    let unknown = refusal("[run]\nsteps = 5\nbatsch = 3\n");
    assert!(unknown.starts_with("/runs/a/train.toml:3: unknown field `batsch`"), "{unknown}");
    assert!(unknown.contains("`batch`") && unknown.contains("(in `batsch = 3`)"), "{unknown}");
    let kind = refusal("[model]\nkind = \"large\"\n");
    assert!(kind.contains("train.toml:2") && kind.contains("`mini`"), "{kind}");
    let wrong_type = refusal("[run]\nsteps = \"many\"\n");
    assert!(wrong_type.contains("train.toml:2") && wrong_type.contains("steps"), "{wrong_type}");
    assert!(refusal("[run\n").contains("train.toml:1"));
    for (text, parts) in [
        ("[run]\nbatch = 0", ["`run.batch` = 0", "at least 1"]),
        ("[run]\ndevice = \"tpu\"", ["`run.device` = \"tpu\"", "one of cpu, cuda"]),
        ("[run]\nminutes = nan", ["`run.minutes`", "positive"]),
        ("[data.simulated]\nside = 512", ["`data.simulated.scene_side` = 384", "512"]),
        ("[data.simulated]\nseed = 4\nheld_out_seed = 4", ["held_out_seed` = 4", "differ"]),
        ("[data]\nsource = \"vigor\"", ["`data.vigor.folder`", "VIGOR"]),
        ("[data.vigor]\nfolder = \"x\"", ["`data.source` = \"simulated\"", "[data.vigor]"]),
        (
            "[objective.paper]\ngravity_points = 1",
            ["`objective.kind` = \"heights\"", "[objective.paper]"],
        ),
        ("[objective.heights]\nslope = -1", ["`objective.heights.slope` = -1.0", "switches"]),
        (
            "[objective.heights]\nslop = 1",
            ["`objective.heights.slop` = 1: there is no such key", "`slope`"],
        ),
        (
            "[objective.heights]\noptimiser.beta3 = 1",
            ["`objective.heights.optimiser.beta3` = 1", "`beta2`"],
        ),
        ("[objective.heights]\nslope = \"a\"", ["`objective.heights.slope` = \"a\"", "f64"]),
        ("[objective.heights]\nsteps = 5", ["`objective.heights.steps` = 5", "`run.steps`"]),
        ("[objective]\nform = \"paper\"", ["`objective.form` = \"paper\"", "belongs to"]),
        ("[model]\nkind = \"reference\"", ["`model.start` = null", "encoder"]),
        ("[model]\nconfig = \"/\"", ["`model.config` = \"/\"", "model.mini"]),
        (
            "[model]\nkind = \"reference\"\nstart = \"/\"",
            ["`model.kind` = \"reference\"", "true heights"],
        ),
        ("[model]\nstart = \"/\"", ["`model.start` = \"/\"", "`sat3d train` wrote"]),
        ("[model]\nstart = \"none\"", ["`model.start` = \"/runs/a/none\"", "does not exist"]),
    ] {
        let error = refusal(text);
        assert!(parts.iter().all(|part| error.contains(part)), "{text}: {error}");
    }
    let here = env!("CARGO_MANIFEST_DIR");
    let vigor = format!("[data]\nsource = \"vigor\"\n[data.vigor]\nfolder = \"{here}\"\n");
    let error = refusal(&vigor);
    assert!(
        error.contains("`objective.kind`") && error.contains("VIGOR has no heights"),
        "{error}"
    );
    let good = format!("[objective]\nkind = \"paper\"\n{vigor}");
    assert_eq!(parse(&good).expect("parses").data.source, DataSource::Vigor);
    let split = refusal(&format!("{good}split = \"training\"\n"));
    assert!(split.contains("`data.vigor.split` = \"training\""), "{split}");
}

#[test]
fn only_what_the_weights_depend_on_is_compared() {
    let identity = |text: &str| {
        let settings = parse(text).expect("parses");
        settings.identity(json!({ "scenes": settings.data.simulated.scenes })).expect("is")
    };
    let first = identity("");
    assert_eq!(difference(&first, &first), None);
    let free = "[run]\nthreads = 1\nkeep = 9\nminutes = 5\nlog_every = 2\n[objective.heights]\n";
    assert_eq!(difference(&first, &identity(free)), None);
    let other = identity("[objective.heights]\nwarm_up = 12\n");
    assert_eq!(
        difference(&first, &other),
        Some(("objective.heights.warm_up".into(), "200".into(), "12".into()))
    );
    let other = identity("[data.simulated]\nscenes = 3\n");
    let (key, _, now) = difference(&first, &other).expect("differs");
    assert_eq!((key.as_str(), now.as_str()), ("data.settings.scenes", "3"));
    let paper = identity("[objective]\nkind = \"paper\"\n");
    assert!(difference(&first, &paper).expect("differs").0.starts_with("objective."));
    let other = identity("[objective]\nkind = \"paper\"\npaper.weights.gravity = 0\n");
    assert_eq!(difference(&paper, &other).expect("differs").0, "objective.paper.weights.gravity");
}

#[test]
fn the_command_line_changes_single_settings() {
    let parse = |changes: &[&str]| {
        let changes: Vec<String> = changes.iter().map(|change| (*change).to_owned()).collect();
        Settings::parse(Path::new("a.toml"), "[run]\nseed = 4\nbatch = 3\n", &changes)
    };
    let settings = parse(&[
        "run.seed=5",
        "run.device=cuda:1",
        "objective.heights.slope = 0",
        "data.simulated.symmetries=none",
    ]);
    let settings = settings.expect("parses");
    assert_eq!((settings.run.seed, settings.run.batch), (5, 3));
    assert_eq!(settings.device().expect("a device"), Device::Cuda(1));
    let slope = settings.terms().expect("terms").into_iter().find(|term| term.name == "slope");
    assert_eq!(slope.expect("is one").weight, 0.0);
    assert_eq!(settings.data.simulated.symmetries, Symmetries::None);
    for (change, part) in [
        ("run.sede=5", "unknown field `sede`"),
        ("seed", "write key=value"),
        ("run.seed.x=1", "`seed` is no table"),
        ("=3", "there is no key"),
        ("run.seed=many", "invalid type"),
    ] {
        let error = parse(&[change]).expect_err(change).to_string();
        assert!(error.starts_with(&format!("--set {change}: ")) && error.contains(part), "{error}");
    }
    assert!(parse(&["run.batch=0"]).expect_err("zero").to_string().contains("`run.batch` = 0"));
}

#[test]
fn the_papers_terms_and_what_the_data_hold_for_them() {
    let terms = |text: &str| {
        let settings = parse(&format!("[objective]\nkind = \"paper\"\n{text}")).expect("parses");
        settings.terms().expect("terms")
    };
    let find = |terms: &[ObjectiveTerm], name: &str| {
        terms.iter().find(|term| term.name == name).expect(name).clone()
    };
    let release = terms("[data.simulated]\nviews = 0\n");
    let panorama = find(&release, "weights.panorama");
    assert_eq!((panorama.weight, panorama.lacks), (3.0, Some("the data have no panoramas")));
    assert_eq!(find(&release, "weights.depth").lacks, None);
    assert_eq!(find(&release, "weights.gravity").weight, 3.5);
    let paper = terms("form = \"paper\"\npaper.weights.gravity = 0\n");
    assert_eq!(find(&paper, "weights.gravity").weight, 0.0);
    assert_eq!(find(&paper, "weights.ortho_opacity").weight, 0.0);
    let folder = env!("CARGO_MANIFEST_DIR");
    assert_eq!(find(&paper, "weights.panorama").lacks, None);
    let vigor = terms(&format!(
        "[data]\nsource = \"vigor\"\nvigor = {{ folder = \"{folder}\", depth = \"\" }}\n"
    ));
    assert_eq!(find(&vigor, "weights.panorama").lacks, None);
    assert_eq!(find(&vigor, "weights.depth").lacks, Some("the data have no depth labels"));
}
