//! The command line as a whole: help, usage errors, messages, closed pipes.

use assert_cmd::Command;
use assert_cmd::cargo::cargo_bin;
use std::process::Stdio;

fn sat3d() -> Command {
    let mut command = Command::new(cargo_bin!("sat3d"));
    // Nothing of the developer's own settings may decide a test.
    command.env_remove("SAT3D_LOG").env_remove("RUST_BACKTRACE").env("COLUMNS", "100");
    command
}

/// What a call prints to standard output; it must succeed.
fn stdout(arguments: &[&str]) -> String {
    let assert = sat3d().args(arguments).assert().code(0).stderr("");
    String::from_utf8(assert.get_output().stdout.clone()).expect("output is UTF-8")
}

/// Exit code and standard error of a call, which must print nothing to standard output.
fn refusal(arguments: &[&str]) -> (i32, String) {
    let output = sat3d().args(arguments).output().expect("runs");
    assert_eq!(String::from_utf8_lossy(&output.stdout), "", "{arguments:?}");
    let text = String::from_utf8(output.stderr).expect("messages are UTF-8");
    (output.status.code().unwrap_or(-1), text)
}

/// Names under `Commands:` in a help text.
fn subcommands(help: &str) -> Vec<String> {
    help.lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| line.starts_with("  "))
        // A deeper indent continues the line before.
        .filter(|line| !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

/// Every subcommand in full (`["dsm-bench", "build"]`) with its help text.
fn leaves() -> Vec<(Vec<String>, String)> {
    fn walk(path: &[String], out: &mut Vec<(Vec<String>, String)>) {
        let mut arguments: Vec<&str> = path.iter().map(String::as_str).collect();
        arguments.push("--help");
        let help = stdout(&arguments);
        let names = subcommands(&help);
        // A command with subcommands may also work by itself (`eval`, `infer`).
        let by_itself = help.lines().any(|line| {
            line.starts_with("Usage: ")
                && line.contains(" [OPTIONS]")
                && !line.contains("<COMMAND>")
        });
        if names.is_empty() || by_itself {
            out.push((path.to_vec(), help));
        }
        for name in names {
            walk(&[path, &[name]].concat(), out);
        }
    }
    let mut leaves = Vec::new();
    walk(&[], &mut leaves);
    leaves
}

#[test]
fn every_subcommand_has_help_with_an_example_of_itself() {
    let leaves = leaves();
    assert!(leaves.iter().any(|(path, _)| path == &["run"]), "{leaves:?}");
    for (path, help) in leaves {
        let name = path.join(" ");
        assert!(help.contains("\nExample"), "`{name}` has no example:\n{help}");
        assert!(help.contains(&format!("\n  sat3d {name}")), "no call of `{name}` in:\n{help}");
        assert!(help.contains("--verbose"), "`{name}` cannot be made to say more");
        let first = help.lines().next().unwrap_or_default();
        assert!(first.len() > 10, "`{name}` does not say what it does: {first:?}");
        // Options are listed with what they do.
        for line in help.lines().filter(|line| line.trim_start().starts_with("--")) {
            let (flag, rest) = line.trim().split_once("  ").unwrap_or((line, ""));
            let below = help.split(line).nth(1).and_then(|rest| rest.lines().nth(1));
            let said = !rest.trim().is_empty() || below.is_some_and(|l| l.starts_with("     "));
            assert!(said, "`{name} {flag}` does not say what it does");
        }
    }
}

#[test]
fn the_reference_of_the_command_line_is_up_to_date() {
    let mut text =
        "# The command line\n\nWhat `--help` says. Written by `UPDATE_DOCS=1 cargo test --test \
                    suite cli::`; the test fails when it is out of date.\n"
            .to_owned();
    let mut add = |title: &str, help: &str| {
        let help: Vec<&str> = help.lines().map(str::trim_end).collect();
        text += &format!("\n## `{title}`\n\n```text\n{}\n```\n", help.join("\n").trim());
    };
    add("sat3d", &stdout(&["--help"]));
    for (path, help) in leaves() {
        add(&format!("sat3d {}", path.join(" ")), &help);
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/cli.md");
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(path, &text).expect("docs/cli.md can be written");
    }
    let stored = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        stored == text,
        "docs/cli.md does not say what --help says; run UPDATE_DOCS=1 cargo test --test suite cli::"
    );
}

#[test]
fn an_unknown_flag_is_bad_usage_everywhere() {
    for (path, _) in leaves() {
        let mut arguments: Vec<&str> = path.iter().map(String::as_str).collect();
        arguments.push("--no-such-flag");
        let (code, text) = refusal(&arguments);
        assert_eq!(code, 2, "{arguments:?}");
        assert!(text.starts_with("error: unexpected argument '--no-such-flag'"), "{text}");
    }
    let (code, text) = refusal(&["dsm-bensh"]);
    assert_eq!(code, 2);
    assert!(text.starts_with("error: unrecognized subcommand 'dsm-bensh'"), "{text}");
}

#[test]
fn without_arguments_help_is_shown_and_that_is_bad_usage() {
    let (code, text) = refusal(&[]);
    assert_eq!(code, 2);
    assert!(text.contains("Usage: sat3d"), "{text}");
    for line in ["0    everything was done", "1    some items", "2    bad usage", "130  interr"] {
        assert!(text.contains(line), "exit codes are not documented: {text}");
    }
}

#[test]
fn the_version_is_the_crates() {
    let version = format!("sat3d {}\n", env!("CARGO_PKG_VERSION"));
    assert_eq!(stdout(&["--version"]), version);
    assert_eq!(stdout(&["-V"]), version);
}

#[test]
fn completions_know_the_subcommands() {
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = stdout(&["completions", shell]);
        for word in ["completions", "run", "dry-run"] {
            assert!(script.contains(word), "{shell} does not know {word}");
        }
    }
    let (code, text) = refusal(&["completions", "csh"]);
    assert_eq!(code, 2);
    assert!(text.contains("possible values: bash, elvish, fish, powershell, zsh"), "{text}");
}

#[test]
fn bash_accepts_its_completions() {
    let script = stdout(&["completions", "bash"]);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("sat3d.bash");
    std::fs::write(&file, script).expect("writes");
    let bash = std::process::Command::new("bash")
        .args(["--norc", "-c", "source \"$0\" && complete -p sat3d"])
        .arg(&file)
        .output();
    match bash {
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stdout);
            assert!(said.contains("-F _sat3d"), "{output:?}");
        }
        Err(_) => eprintln!("SKIPPED bash_accepts_its_completions: bash is not installed"),
    }
}

#[test]
fn messages_can_be_filtered_but_not_with_nonsense() {
    let (code, text) = refusal(&["--log", "a=b=c", "completions", "bash"]);
    assert_eq!(code, 2);
    assert!(text.starts_with("error: --log `a=b=c` is no filter: "), "{text}");
    assert_eq!(text.lines().count(), 1, "{text}");
    let (code, text) = refusal(&["-q", "-v", "completions", "bash"]);
    assert_eq!(code, 2);
    assert!(text.contains("cannot be used with"), "{text}");
    // The same flags stand before or behind the subcommand.
    stdout(&["completions", "bash", "--log", "sat3d=debug", "-vv"]);
}

/// Runs with a standard output that nobody reads any more.
fn into_a_closed_pipe(arguments: &[&str]) -> (Option<i32>, String) {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let child = std::process::Command::new(cargo_bin!("sat3d"))
        .args(arguments)
        .stdout(writer)
        .stderr(Stdio::piped())
        .spawn()
        .expect("starts");
    let output = child.wait_with_output().expect("ends");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn a_closed_pipe_ends_quietly() {
    assert_eq!(into_a_closed_pipe(&["completions", "bash"]), (Some(0), String::new()));
    assert_eq!(into_a_closed_pipe(&["--help"]), (Some(0), String::new()));
    // Printed by `println!`, which panics on a closed pipe.
    let recipe = concat!(env!("CARGO_MANIFEST_DIR"), "/pipelines/vigor_ood.toml");
    assert_eq!(into_a_closed_pipe(&["run", recipe, "--dry-run"]), (Some(0), String::new()));
}

#[test]
fn colours_need_a_terminal() {
    let (_, text) = refusal(&["--no-such-flag"]);
    assert!(!text.contains('\u{1b}'), "{text:?}");
    let (_, text) = refusal(&["run", "/no/such/recipe.toml"]);
    assert!(!text.contains('\u{1b}'), "{text:?}");
}
