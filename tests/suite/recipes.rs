//! `sat3d run`, driven as a user drives it, on chains of small `vigor ingest` steps.

use crate::common;

use common::{run, stderr, stdout};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A folder with a recipe in `recipes/` and a little VIGOR city in `data/Seattle/`.
struct Case {
    folder: tempfile::TempDir,
}

impl Case {
    fn new(recipe: &str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let city = folder.path().join("data/Seattle");
        fs::create_dir_all(&city).expect("a folder");
        fs::create_dir(folder.path().join("recipes")).expect("a folder");
        let names = "satellite_47.6_-122.33.png\nsatellite_47.601_-122.331.png\n";
        fs::write(city.join("satellite_list.txt"), names).expect("writes");
        fs::write(folder.path().join("recipes/r.toml"), recipe).expect("writes");
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// `sat3d run recipes/r.toml ...` in the folder.
    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = common::sat3d();
        command.args(["run", "recipes/r.toml"]).args(arguments).current_dir(self.folder.path());
        command
    }

    /// What is told about a recipe that is refused.
    fn refusal(recipe: &str) -> String {
        let output = run(&mut Self::new(recipe).command(&[]), 2);
        assert_eq!(stdout(&output), "");
        stderr(&output)
    }
}

const TWO_STEPS: &str = r#"
description = "Ingests a city twice."
closing = "The lists are in ${out}."

[paths]
out = "../made"
city = "../data/Seattle"

[[step]]
command = "vigor ingest"
folder = "${city}"
out = "${out}/one"

[[step]]
command = "vigor ingest"
folder = "${city}"
out = "${out}/two"
"#;

#[test]
fn a_chain_runs_and_says_how_each_step_ended() {
    let case = Case::new(TWO_STEPS);
    let output = run(&mut case.command(&[]), 0);
    let told = stderr(&output);
    assert!(
        told.starts_with("[1/2] sat3d vigor ingest data/Seattle --out made/one\n")
            && told.contains("\n[2/2] sat3d vigor ingest data/Seattle --out made/two\n"),
        "{told}"
    );
    let text = stdout(&output);
    let summary = text.split("\nrecipes/r.toml\n").nth(1).expect("a summary");
    let lines: Vec<Vec<&str>> =
        summary.lines().take(2).map(|line| line.split_whitespace().collect()).collect();
    assert_eq!(lines[0][..4], ["1", "vigor", "ingest", "done"], "{summary}");
    assert_eq!(lines[1][..4], ["2", "vigor", "ingest", "done"], "{summary}");
    assert!(summary.ends_with("\nThe lists are in made.\n"), "{summary}");
    for step in ["one", "two"] {
        assert!(case.path(&format!("made/{step}/summary.json")).is_file());
    }
}

#[test]
fn quiet_leaves_the_results_alone() {
    let case = Case::new(TWO_STEPS);
    let output = run(&mut case.command(&["-q"]), 0);
    assert_eq!(stderr(&output), "");
    assert!(stdout(&output).contains("made"));
}

#[test]
fn a_dry_run_prints_command_lines_and_makes_nothing() {
    let case = Case::new(TWO_STEPS);
    let output = run(&mut case.command(&["--dry-run", "--set", "out=else where"]), 0);
    assert_eq!(
        stdout(&output),
        "sat3d vigor ingest data/Seattle --out 'else where/one'\n\
         sat3d vigor ingest data/Seattle --out 'else where/two'\n"
    );
    assert_eq!(stderr(&output), "");
    assert!(!case.path("made").exists() && !case.path("else where").exists());
}

#[test]
fn the_model_of_the_program_is_a_name_and_no_path() {
    let recipe = r#"
description = "Infers."
[paths]
city = "../data/Seattle"
out = "../made"
[[step]]
command = "infer"
input = "${city}"
weights = "built-in:mini"
out = "${out}"
"#;
    let output = run(&mut Case::new(recipe).command(&["--dry-run"]), 0);
    assert_eq!(stdout(&output), "sat3d infer data/Seattle --weights built-in:mini --out made\n");
}

#[test]
fn json_is_one_object_with_every_report() {
    let case = Case::new(TWO_STEPS);
    let output = run(&mut case.command(&["--json"]), 0);
    let report: Value = serde_json::from_str(&stdout(&output)).expect("one JSON object");
    assert_eq!((&report["recipe"], &report["exit_code"]), (&"recipes/r.toml".into(), &0.into()));
    let steps = report["steps"].as_array().expect("a list of steps");
    assert_eq!(steps.len(), 2);
    for (step, name) in steps.iter().zip(["made/one", "made/two"]) {
        assert_eq!(step["command"], "vigor ingest");
        assert_eq!(step["arguments"], serde_json::json!(["data/Seattle", "--out", name]));
        assert_eq!(step["status"], "done");
        assert!(step["report"].is_object(), "the step's own JSON: {step:#}");
    }
}

#[test]
fn a_mistake_in_the_last_step_is_found_before_the_first_runs() {
    let case = Case::new(&TWO_STEPS.replace("\"${out}/two\"", "\"${out}/two\"\nzoom = 99"));
    let output = run(&mut case.command(&[]), 2);
    assert_eq!(
        stderr(&output),
        "error: recipes/r.toml:15: step 2 (vigor ingest): invalid value '99' for '--zoom <ZOOM>': 99 \
         is not in 0..=30\n"
    );
    assert!(!case.path("made").exists());
}

#[test]
fn a_step_that_cannot_work_stops_the_chain() {
    let case = Case::new(&TWO_STEPS.replace("../data/Seattle", "../data/Tacoma"));
    let output = run(&mut case.command(&[]), 2);
    assert!(stderr(&output).contains("error: "), "{}", stderr(&output));
    let text = stdout(&output);
    assert!(text.contains("1  vigor ingest  failed"), "{text}");
    assert!(text.contains("2  vigor ingest  not run"), "{text}");
    assert!(!text.contains("The lists are in"), "{text}");

    let output = run(&mut case.command(&["--json"]), 2);
    let report: Value = serde_json::from_str(&stdout(&output)).expect("one JSON object");
    assert_eq!(report["steps"][0]["status"], "failed");
    assert!(report["steps"][0]["error"].is_string());
    assert_eq!(report["steps"][1]["status"], "not run");
}

#[test]
fn a_step_of_which_some_items_fail_does_not_stop_the_chain() {
    let case = Case::new(TWO_STEPS);
    // A line that is no label: recorded as a problem of the file, and the rest is read.
    let labels = case.path("data/Seattle/pano_label_balanced.txt");
    fs::write(labels, "this is no label\n").expect("writes");
    let output = run(&mut case.command(&[]), 1);
    let text = stdout(&output);
    assert!(text.contains("1  vigor ingest  some failed"), "{text}");
    assert!(text.contains("2  vigor ingest  some failed"), "{text}");
    assert!(text.ends_with("\nThe lists are in made.\n"), "{text}");
}

#[test]
fn explaining_names_what_is_not_there_yet_and_makes_nothing() {
    let recipe = r#"
        description = "Two steps, of which the second needs the first."
        [[step]]
        command = "vigor ingest"
        folder = "../data/Seattle"
        out = "../made"
        [[step]]
        command = "dsm-bench build"
        lidar = ["../made/tiles"]
        vigor = "../data/Seattle"
        out = "../dsm"
        "#;
    let case = Case::new(recipe);
    let output = run(&mut case.command(&["--explain"]), 0);
    assert_eq!(
        stdout(&output),
        "Two steps, of which the second needs the first.\n\n\
         step 1 of 2: sat3d vigor ingest data/Seattle --out made\n  \
         (this command has no plan to explain)\n\n\
         step 2 of 2: sat3d dsm-bench build --lidar made/tiles --vigor data/Seattle --out dsm\n  \
         (its plan depends on made/tiles, which step 1 makes; explain again after that)\n\n"
    );
    assert!(!case.path("made").exists() && !case.path("dsm").exists());

    // An input that no step makes is an error of the chain.
    let case = Case::new(&recipe.replace("../made/tiles", "../nowhere"));
    let output = run(&mut case.command(&["--explain"]), 2);
    assert!(stderr(&output).contains("nowhere"), "{}", stderr(&output));
}

#[test]
fn an_interrupt_stops_the_chain_between_its_steps() {
    let mut recipe = "[paths]\ncity = '../data/Seattle'\n".to_owned();
    for number in 0..300 {
        recipe += "[[step]]\ncommand = 'vigor ingest'\nfolder = '${city}'\n";
        recipe += &format!("out = '../made/{number}'\n");
    }
    let case = Case::new(&recipe);
    let mut child = case
        .command(&["--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("starts");
    let mut told = BufReader::new(child.stderr.take().expect("is piped"));
    let mut line = String::new();
    told.read_line(&mut line).expect("the first step is announced");
    assert!(line.starts_with("[1/300] "), "{line}");
    let kill = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(kill.is_ok_and(|status| status.success()), "the signal is sent");
    // Both pipes are read to the end at once, so that the child never waits for us.
    let rest = std::thread::spawn(move || told.lines().map_while(Result::ok).count());
    let output = child.wait_with_output().expect("ends");
    rest.join().expect("standard error is read");
    assert_eq!(output.status.code(), Some(130));
    let report: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(report["exit_code"], 130);
    assert_eq!(report["steps"].as_array().map(Vec::len), Some(300));
    assert_eq!(report["steps"][299]["status"], "not run");
}

#[test]
fn a_recipe_that_is_wrong_is_refused_with_help() {
    assert_eq!(
        Case::refusal("[[step]]\ncommand = 'vigor ingest'\nfolder = 'x'\nverfy = 'full'"),
        "error: recipes/r.toml:4: step 1 (vigor ingest): unknown key `verfy`\n  help: did you mean \
         `verify`? (keys: folder, city, labels, out, verify, gpkg, zoom, size, resolution)\n"
    );
    let text = Case::refusal("[[step]]\ncommand = 'vigor injest'");
    assert!(
        text.starts_with(
            "error: recipes/r.toml:2: step 1 (vigor injest): unknown command `vigor injest`\n  \
             help: did you mean `vigor ingest`? (commands: "
        ),
        "{text}"
    );
    assert_eq!(
        Case::refusal("[[step]]\ncommand = 'vigor ingest'\nfolder = ['a', 'b']"),
        "error: recipes/r.toml:3: step 1 (vigor ingest): `folder` is a list, but must be one value\n"
    );
    assert_eq!(
        Case::refusal("[[step]]\ncommand = 'vigor ingest'"),
        "error: recipes/r.toml:2: step 1 (vigor ingest): the following required arguments were not \
         provided: <FOLDER>\n"
    );
    assert_eq!(
        Case::refusal(
            "[[step]]\ncommand = 'vigor ingest'\nfolder = '${ctiy}'\n[paths]\ncity = 'x'"
        ),
        "error: recipes/r.toml:3: step 1 (vigor ingest): `folder` uses the variable `${ctiy}`, which \
         is not defined\n  help: did you mean `city`? (variables: city)\n"
    );
    let text = Case::refusal("[[step]\n");
    assert!(text.starts_with("error: recipes/r.toml:1: not TOML: "), "{text}");

    let case = Case::new(TWO_STEPS);
    let output = run(&mut case.command(&["--set", "ctiy=x"]), 2);
    assert_eq!(
        stderr(&output),
        "error: --set `ctiy`: recipes/r.toml defines no such variable\n  help: did you mean `city`? \
         (variables: city, out)\n"
    );
    let mut missing = common::sat3d();
    let text = stderr(&run(missing.args(["run", "/no/such/recipe.toml"]), 2));
    assert!(
        text.starts_with("error: cannot read the recipe /no/such/recipe.toml: No such"),
        "{text}"
    );
    assert_eq!(text.lines().count(), 1, "the cause is said once: {text}");
}

#[test]
fn every_recipe_that_comes_with_sat3d_is_right() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines");
    let mut count = 0;
    for entry in fs::read_dir(folder).expect("lists").flatten() {
        if entry.path().extension() == Some("toml".as_ref()) {
            let mut command = common::sat3d();
            run(command.arg("run").arg(entry.path()).arg("--dry-run"), 0);
            count += 1;
        }
    }
    assert!(count >= 2, "the recipes are gone");
}
