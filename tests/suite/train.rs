//! `sat3d train` end to end, with a toy for a learner where the network does not matter: interrupted, resumed, out
//! of disk, on bad data.
#![cfg(feature = "train")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;
use crate::train_support;

use common::{run as call, sat3d, skipped, stderr, stdout};
use sat3d::batch::Interrupt;
use sat3d::train::{Ending, journal};
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use train_support::{SHORT, assert_same, habits, left, train};

/// Environment of the test that is run as another process: the folder to train in.
const CHILD: &str = "SAT3D_TRAIN_CHILD";

/// Not a test by itself: the training that others start as a process of its own and kill.
#[test]
fn child() {
    let Some(out) = std::env::var_os(CHILD) else { return };
    let mut habits = habits();
    habits.pause = Duration::from_millis(15);
    habits.ballast = 400_000;
    train(SHORT, &[], Path::new(&out), &Interrupt::default(), &habits).unwrap();
}

fn spawn(out: &Path) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "train::child", "--quiet"])
        .env(CHILD, out)
        .stdout(Stdio::null())
        .spawn()
        .unwrap()
}

/// Kills the process (SIGKILL) as soon as `when` holds; false when it ended before.
fn kill_when(mut child: Child, when: impl Fn() -> bool) -> bool {
    let started = Instant::now();
    loop {
        if child.try_wait().unwrap().is_some() {
            return false;
        }
        if when() {
            child.kill().unwrap();
            child.wait().unwrap();
            return true;
        }
        assert!(started.elapsed() < Duration::from_secs(300), "the child hangs");
        std::thread::sleep(Duration::from_micros(200));
    }
}

fn begins(out: &Path, name: &str) -> bool {
    fs::read_dir(out).is_ok_and(|items| {
        items.filter_map(Result::ok).any(|i| i.file_name().to_string_lossy().starts_with(name))
    })
}

#[test]
fn killed_at_any_moment_and_resumed_it_leaves_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (folder.path().join("whole"), folder.path().join("broken"));
    assert!(spawn(&whole).wait().unwrap().success());
    assert!(whole.join("checkpoint-24/train.json").is_file());
    // Before the first checkpoint; while one is written; between two; after the pictures of a later step.
    let moments: [Box<dyn Fn() -> bool>; 4] = [
        Box::new(|| fs::metadata(broken.join("log.jsonl")).is_ok_and(|m| m.len() > 0)),
        Box::new(|| begins(&broken, ".checkpoint-6.")),
        Box::new(|| begins(&broken, "checkpoint-12")),
        Box::new(|| broken.join("pictures/1-dsm-24.png").is_file()),
    ];
    let mut killed = 0;
    for moment in moments {
        killed += u32::from(kill_when(spawn(&broken), moment));
    }
    assert!(killed >= 3, "{killed} of 4 kills came in time");
    assert!(spawn(&broken).wait().unwrap().success());
    assert_same(&whole, &broken);
    let run = fs::read_to_string(broken.join("run.json")).unwrap();
    assert!(run.contains("\"sessions\""), "{run}");
}

#[test]
fn a_training_leaves_what_was_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("a");
    let summary = train(SHORT, &[], &out, &Interrupt::default(), &habits()).unwrap();
    assert_eq!((summary.ending, summary.step, summary.resumed_from), (Ending::Finished, 24, None));
    assert_eq!(summary.progress.images, 72);
    let names: Vec<String> = left(&out).keys().map(|p| p.to_string_lossy().into_owned()).collect();
    for file in ["checkpoint-24/vqmodel/config.json", "checkpoint-18/state.safetensors", "log.html"]
    {
        assert!(names.iter().any(|name| name == file), "{file} in {names:?}");
    }
    assert!(!names.iter().any(|name| name.starts_with("checkpoint-12")), "two are kept: {names:?}");
    // Six lines of the log, two looks at held-out scenes.
    let lines = journal::read(&out);
    let logged: Vec<u64> = lines.iter().filter(|l| l.images.is_some()).map(|l| l.step).collect();
    assert_eq!(logged, [4, 8, 12, 16, 20, 24]);
    assert_eq!(lines.iter().filter(|line| line.held_out.is_some()).count(), 2);
    let terms: Vec<&String> = lines[0].terms.keys().collect();
    assert_eq!(terms, ["total", "even", "odd"]);
    // The toy follows its target.
    let loss = |line: &journal::Line| line.terms["total"].as_f64().unwrap();
    assert!(loss(&lines[0]) > loss(lines.iter().rfind(|l| l.images.is_some()).unwrap()));
    // The page stands by itself.
    let page = fs::read_to_string(out.join("log.html")).unwrap();
    for part in
        ["<svg", "data:image/png;base64,", "prefers-color-scheme:dark", "held-out error", "step 24"]
    {
        assert!(page.contains(part), "{part}");
    }
    assert!(!page.contains("http://") && !page.contains("https://") && !page.contains("NaN"));
    // What was trained is a checkpoint that other commands take.
    let mut inspect = sat3d();
    inspect.args(["model", "inspect"]).arg(out.join("checkpoint-24"));
    assert!(stdout(&call(&mut inspect, 0)).contains("vqmodel_ema"));
    // Once more: nothing to do, and nothing changes.
    let before = left(&out);
    let again = train(SHORT, &[], &out, &Interrupt::default(), &habits()).unwrap();
    assert_eq!(again.ending, Ending::Unchanged);
    assert!(left(&out) == before);
}

#[test]
fn threads_and_what_is_made_ahead_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    train(SHORT, &[], &a, &Interrupt::default(), &habits()).unwrap();
    let other = ["run.threads=1", "data.threads=1", "data.ahead=0", "data.simulated.memory_mib=0"];
    train(SHORT, &other, &b, &Interrupt::default(), &habits()).unwrap();
    assert_same(&a, &b);
    let c = folder.path().join("c");
    train(SHORT, &["run.seed=12"], &c, &Interrupt::default(), &habits()).unwrap();
    let weights = Path::new("checkpoint-24/state.safetensors");
    assert_ne!(left(&a)[weights], left(&c)[weights]);
}

#[test]
fn interrupted_or_out_of_time_it_writes_a_checkpoint_and_goes_on_from_there() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (folder.path().join("whole"), folder.path().join("broken"));
    train(SHORT, &[], &whole, &Interrupt::default(), &habits()).unwrap();
    let interrupt = Interrupt::default();
    let mut stopping = habits();
    stopping.stops = Some((8, interrupt.clone()));
    let summary = train(SHORT, &[], &broken, &interrupt, &stopping).unwrap();
    assert_eq!((summary.ending, summary.step), (Ending::Interrupted, 9));
    assert_eq!(summary.exit_code() as i32, 130);
    assert!(broken.join("checkpoint-9/train.json").is_file());
    let mut slow = habits();
    slow.pause = Duration::from_millis(150);
    let summary =
        train(SHORT, &["run.minutes=0.005"], &broken, &Interrupt::default(), &slow).unwrap();
    assert_eq!((summary.ending, summary.resumed_from), (Ending::Time, Some(9)));
    assert!((10..24).contains(&summary.step), "{}", summary.step);
    train(SHORT, &[], &broken, &Interrupt::default(), &habits()).unwrap();
    assert_same(&whole, &broken);
}

#[test]
fn other_settings_are_refused_with_the_key_and_free_ones_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let interrupt = Interrupt::default();
    let mut stopping = habits();
    stopping.stops = Some((6, interrupt.clone()));
    train(SHORT, &[], folder.path(), &interrupt, &stopping).unwrap();
    for (change, parts) in [
        ("run.batch=4", ["`run.batch`", "(3, now 4)"]),
        ("run.seed=12", ["`run.seed`", "(11, now 12)"]),
        ("data.simulated.scenes=4", ["scenes`", "(3, now 4)"]),
        ("objective.heights.slope=0", ["`objective.heights.slope`", "now 0.0)"]),
    ] {
        let error = train(SHORT, &[change], folder.path(), &Interrupt::default(), &habits());
        let error = error.unwrap_err().to_string();
        assert!(
            parts.iter().all(|part| error.contains(part)) && error.contains("--out"),
            "{error}"
        );
    }
    let free = ["run.keep=1", "run.threads=1", "run.checkpoint_every=9", "data.ahead=1"];
    train(SHORT, &free, folder.path(), &Interrupt::default(), &habits()).unwrap();
}

#[test]
fn batches_that_are_not_finite_are_counted_and_too_many_end_the_training() {
    let folder = tempfile::tempdir().unwrap();
    let mut some = habits();
    some.not_finite = |step| step == 3 || step == 4 || step == 17;
    let out = folder.path().join("some");
    let summary = train(SHORT, &["run.skipped_in_a_row=3"], &out, &Interrupt::default(), &some);
    let summary = summary.unwrap();
    assert_eq!((summary.progress.skipped_batches, summary.progress.images), (3, 63));
    let lines = journal::read(&out);
    let skipped: Vec<u64> = lines.iter().filter(|l| l.skipped.is_some()).map(|l| l.step).collect();
    assert_eq!(skipped, [4, 5, 18]);
    let page = fs::read_to_string(out.join("log.html")).unwrap();
    assert!(page.contains("step 18: the height is NaN"));
    let mut many = habits();
    many.not_finite = |step| step >= 8;
    let out = folder.path().join("many");
    let error = train(SHORT, &["run.skipped_in_a_row=5"], &out, &Interrupt::default(), &many);
    let error = error.unwrap_err().to_string();
    assert!(error.contains("5 batches in a row") && error.contains("the height is NaN"), "{error}");
    // The last good one is there.
    assert!(out.join("checkpoint-6/train.json").is_file());
    assert!(!out.join("checkpoint-18").exists());
}

#[test]
fn a_damaged_checkpoint_costs_the_steps_since_the_one_before() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (folder.path().join("whole"), folder.path().join("broken"));
    train(SHORT, &[], &whole, &Interrupt::default(), &habits()).unwrap();
    let interrupt = Interrupt::default();
    let mut stopping = habits();
    stopping.stops = Some((13, interrupt.clone()));
    train(SHORT, &[], &broken, &interrupt, &stopping).unwrap();
    let state = broken.join("checkpoint-14/state.safetensors");
    let bytes = fs::read(&state).unwrap();
    fs::write(&state, &bytes[..bytes.len() - 2]).unwrap();
    let summary = train(SHORT, &[], &broken, &Interrupt::default(), &habits()).unwrap();
    assert_eq!(summary.resumed_from, Some(12));
    assert_same(&whole, &broken);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_leaves_the_last_good_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let disk = folder.path().join("disk");
    fs::create_dir(&disk).unwrap();
    let mount = |arguments: &[&str]| {
        let status = Command::new("mount").args(arguments).arg(&disk).status();
        status.is_ok_and(|status| status.success())
    };
    if !mount(&["-t", "tmpfs", "-o", "size=28m", "tmpfs"]) {
        skipped("a_full_disk_leaves_the_last_good_checkpoint", "cannot mount a tmpfs");
        return;
    }
    // Checkpoints of 17 MB: one fits, a second beside it does not.
    let mut large = habits();
    large.ballast = 2_000_000;
    let full = train(SHORT, &[], &disk, &Interrupt::default(), &large);
    let first = left(&disk);
    let grown = mount(&["-o", "remount,size=200m"]);
    let again = train(SHORT, &[], &disk, &Interrupt::default(), &large);
    let unmounted = Command::new("umount").arg(&disk).status().unwrap();
    let error = full.unwrap_err().to_string();
    assert!(error.contains("space") && error.contains("checkpoint-12"), "{error}");
    assert!(first.contains_key(Path::new("checkpoint-6/train.json")));
    let of_the_second =
        |path: &&std::path::PathBuf| path.to_string_lossy().contains("checkpoint-12");
    assert_eq!(first.keys().find(of_the_second), None);
    assert!(grown && unmounted.success());
    let again = again.unwrap();
    assert_eq!((again.resumed_from, again.ending), (Some(6), Ending::Finished));
}

#[test]
fn two_trainings_do_not_share_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join(".sat3d")).unwrap();
    let lock = fs::File::create(folder.path().join(".sat3d/lock")).unwrap();
    lock.lock().unwrap();
    let error = train(SHORT, &[], folder.path(), &Interrupt::default(), &habits()).unwrap_err();
    assert!(error.to_string().contains("another sat3d run"), "{error}");
}

/// A small network on two scenes, with the built program's own learner.
const REAL: &str = r#"
[model]
mini = { widths = [8, 8, 8], blocks = [1, 1, 1], attention = 1, heads = 2, channels = 4, hidden = 4 }
[data]
threads = 1
held_out = 1
simulated = { scenes = 2, scene_side = 264, side = 256, pixel_m = 0.3 }
[run]
steps = 6
batch = 2
checkpoint_every = 2
log_every = 2
preview_every = 4
threads = 2
"#;

#[test]
fn the_built_program_killed_and_resumed_leaves_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (folder.path().join("whole"), folder.path().join("broken"));
    let config = folder.path().join("train.toml");
    fs::write(&config, REAL).unwrap();
    let command = |out: &Path, arguments: &[&str]| {
        let mut command = sat3d();
        command.arg("train").arg(&config).arg("--out").arg(out).args(arguments);
        command
    };
    let json = stdout(&call(&mut command(&whole, &["--json", "-q"]), 0));
    let summary: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&summary["ending"], &summary["step"]), (&"finished".into(), &6.into()), "{json}");
    assert!(summary["held_out"]["rmse_m"].as_f64().unwrap() > 0.0, "{json}");
    let killed =
        kill_when(command(&broken, &["-q"]).spawn().unwrap(), || begins(&broken, "checkpoint-2"));
    assert!(killed, "the program ended before it was killed");
    // Ctrl-C on the way is no end either.
    let child = command(&broken, &[]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let interrupted = interrupt_when(child, || begins(&broken, "log.jsonl"));
    // None: before the program listened; 0: after its last step.
    assert!(matches!(interrupted, Some(130 | 0) | None), "{interrupted:?}");
    let output = call(&mut command(&broken, &[]), 0);
    assert!(stdout(&output).contains("6 of 6 steps"), "{}", stdout(&output));
    assert_same(&whole, &broken);
    // What was trained makes a DSM.
    let image = folder.path().join("image.png");
    image::RgbImage::from_pixel(64, 64, image::Rgb([90, 100, 80])).save(&image).unwrap();
    let mut infer = sat3d();
    infer.arg("infer").arg(&image).arg("--weights").arg(whole.join("checkpoint-6"));
    infer.arg("--out").arg(folder.path().join("dsm"));
    call(&mut infer, 0);
    let heights = common::npz(&folder.path().join("dsm/image.npz"), "arr_0");
    assert!(heights.len() == 256 * 256 && heights.iter().all(|height| height.is_finite()));
}

#[test]
fn the_papers_signals_are_learnt_from_simulated_streets() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("train.toml");
    let text = r#"
[model]
mini = { widths = [8, 8, 8], blocks = [1, 1, 1], attention = 1, heads = 2, channels = 4, hidden = 8 }
[objective]
kind = "paper"
[objective.paper]
discriminator_channels = 16
gravity_points = 50
[objective.paper.views]
ortho_grid = 24
ortho_window = 16
panorama_width = 32
panorama_height = 8
perspective = 16
coarse_samples = 8
fine_samples = 0
[data]
held_out = 1
simulated = { scenes = 2, scene_side = 80, side = 64, pixel_m = 1.0, views = 2, panorama_width = 64 }
[run]
steps = 4
batch = 2
checkpoint_every = 2
keep = 1
log_every = 2
preview_every = 4
"#;
    fs::write(&config, text).unwrap();
    let command = |out: &str, arguments: &[&str]| {
        let mut command = sat3d();
        command.arg("train").arg(&config).arg("--out").arg(folder.path().join(out)).args(arguments);
        command
    };
    let plan = stdout(&call(&mut command("a", &["--explain"]), 0));
    assert!(
        plan.contains("substitute for LPIPS") && plan.contains("2 panoramas of 64 px"),
        "{plan}"
    );
    let json = stdout(&call(&mut command("a", &["--json", "-q"]), 0));
    let summary: serde_json::Value = serde_json::from_str(&json).unwrap();
    let terms: Vec<&String> = summary["terms"].as_object().unwrap().keys().collect();
    for part in ["panorama", "depth", "gravity", "discriminator"] {
        assert!(terms.iter().any(|term| term.contains(part)), "{part} in {terms:?}");
    }
    // In two pieces it ends the same.
    call(&mut command("b", &["-q", "--set", "run.minutes=0.0001"]), 0);
    call(&mut command("b", &["-q"]), 0);
    assert_same(&folder.path().join("a"), &folder.path().join("b"));
}

/// Sends SIGINT once `when` holds; the exit code.
fn interrupt_when(mut child: Child, when: impl Fn() -> bool) -> Option<i32> {
    while !when() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    std::thread::sleep(Duration::from_millis(300));
    let _ = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    child.wait().unwrap().code()
}

/// A VIGOR folder of one city with `good` usable items, one without its panorama and one whose mask is too small.
fn vigor(root: &Path, good: usize) {
    for name in ["satellite", "panorama", "pano_sky_mask"] {
        fs::create_dir_all(root.join("Seattle").join(name)).unwrap();
    }
    let mut lines = String::new();
    for i in 0..good + 2 {
        let satellite = format!("Seattle/satellite/satellite_47.60{i}_-122.33.png");
        let panorama = format!("Seattle/panorama/p{i},47.6,-122.33,.png");
        let mask = format!("Seattle/pano_sky_mask/p{i},47.6,-122.33,.png");
        let grey = image::Rgb([90, 100 + i as u8, 110]);
        image::RgbImage::from_pixel(40, 40, grey).save(root.join(&satellite)).unwrap();
        if i != good {
            image::RgbImage::from_pixel(64, 32, grey).save(root.join(&panorama)).unwrap();
        }
        let size = if i == good + 1 { (32, 16) } else { (64, 32) };
        image::GrayImage::new(size.0, size.1).save(root.join(&mask)).unwrap();
        lines += &format!("{satellite} {panorama} {mask} 5 -7\n");
    }
    fs::write(root.join("train_pairs.txt"), lines).unwrap();
}

const VIGOR: &str = r#"
[objective]
kind = "paper"
[data]
source = "vigor"
vigor = { folder = "FOLDER", side = 32 }
[run]
steps = 9
batch = 4
checkpoint_every = 4
"#;

#[test]
fn items_that_are_no_good_are_counted_and_nothing_good_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("vigor");
    vigor(&root, 4);
    let text = VIGOR.replace("FOLDER", &root.to_string_lossy());
    let out = folder.path().join("out");
    let summary = train(&text, &[], &out, &Interrupt::default(), &habits()).unwrap();
    // 36 draws of 6 items: each of the two bad ones came up six times, the second also after the first.
    let items = &summary.progress.skipped_items;
    let kinds: Vec<&String> = items.keys().collect();
    assert_eq!(kinds, ["panorama missing", "sky mask of another size"]);
    assert!(items["panorama missing"].draws >= 6 && items["sky mask of another size"].draws >= 6);
    assert_eq!((summary.progress.images, summary.progress.without_depth), (36, 36));
    let page = fs::read_to_string(out.join("log.html")).unwrap();
    assert!(page.contains("draws: panorama missing"));
    // Interrupted, the counts are the same.
    let again = folder.path().join("again");
    let interrupt = Interrupt::default();
    let mut stopping = habits();
    stopping.stops = Some((5, interrupt.clone()));
    train(&text, &[], &again, &interrupt, &stopping).unwrap();
    train(&text, &[], &again, &Interrupt::default(), &habits()).unwrap();
    let description = Path::new("checkpoint-9/train.json");
    assert_eq!(left(&again)[description], left(&out)[description]);
    fs::remove_dir_all(root.join("Seattle/pano_sky_mask")).unwrap();
    let none = train(&text, &[], &folder.path().join("none"), &Interrupt::default(), &habits());
    let error = none.unwrap_err().to_string();
    assert!(error.contains("none of 6 items is any good"), "{error}");
    assert!(error.contains("sky mask missing") && error.contains("panorama missing"), "{error}");
}

#[test]
fn the_command_line_explains_and_refuses() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("train.toml");
    fs::write(&config, SHORT).unwrap();
    let command = |arguments: &[&str]| {
        let mut command = sat3d();
        command.arg("train").arg(&config).args(arguments);
        command.arg("--out").arg(folder.path().join("out"));
        command
    };
    let plan = stdout(&call(&mut command(&["--explain"]), 0));
    for part in ["3 simulated scenes of 48 px", "loss.slope", "24 steps of 3", "seed 11", "mini"] {
        assert!(plan.contains(part), "{part} in\n{plan}");
    }
    let json = stdout(&call(
        &mut command(&["--explain", "--json", "--set", "objective.heights.slope=0"]),
        0,
    ));
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    let steps = json["steps"].as_array().unwrap();
    let slope = steps.iter().find(|step| step["id"] == "loss.slope").unwrap();
    assert_eq!((&slope["on"], &slope["reason"]), (&false.into(), &"its weight is 0".into()));
    // Nothing was written for an explanation.
    assert!(!folder.path().join("out").exists());
    let error = stderr(&call(&mut command(&["--set", "run.batch=0"]), 2));
    assert!(
        error.starts_with("error: ") && error.contains("`run.batch` = 0: at least 1"),
        "{error}"
    );
    fs::write(&config, "[run]\nstep = 3\n").unwrap();
    let error = stderr(&call(&mut command(&[]), 2));
    assert!(error.contains("train.toml:2: unknown field `step`"), "{error}");
    let mut missing = sat3d();
    missing.args(["train", "/no/such/train.toml"]);
    assert!(stderr(&call(&mut missing, 2)).contains("/no/such/train.toml"));
}

#[test]
fn the_examples_of_the_documentation_are_read() {
    for name in ["mini.toml", "mini-self.toml", "paper.toml"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines/train").join(name);
        // The data set of the second is the user's own.
        let folder = tempfile::tempdir().unwrap();
        let change = match name {
            "paper.toml" => ["data.vigor.folder", "model.start"]
                .map(|key| format!("{key}={}", folder.path().display()))
                .into(),
            _ => Vec::new(),
        };
        sat3d::train::Settings::read(&path, &change).unwrap();
    }
}
