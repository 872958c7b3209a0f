//! Every `sh` block of README.md, run in order in one folder; every link of the docs, followed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The text of all fenced blocks of one language.
fn blocks(markdown: &str, language: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut open: Option<(bool, String)> = None;
    for line in markdown.lines() {
        match (&mut open, line.strip_prefix("```")) {
            (None, Some(info)) => open = Some((info == language, String::new())),
            (Some((wanted, text)), Some(_)) => {
                if *wanted {
                    blocks.push(std::mem::take(text));
                }
                open = None;
            }
            (Some((_, text)), None) => *text += &format!("{line}\n"),
            (None, None) => {}
        }
    }
    blocks
}

/// The scene of the quickstart with fewer images, so that an unoptimised build is done in seconds.
fn smaller(scene: &str) -> String {
    let mut table: toml::Table = scene.parse().expect("the scene is TOML");
    // The first images lie where the water is, and all would be skipped.
    table.remove("water");
    let images = table.entry("images").or_insert_with(|| toml::Table::new().into());
    let images = images.as_table_mut().expect("[images] is a table");
    images.insert("maximum".into(), 4.into());
    table.to_string()
}

#[test]
fn every_command_in_the_readme_works() {
    let commands = blocks(&read(&root().join("README.md")), "sh");
    assert!(commands.len() >= 4, "the quickstart is gone: {commands:?}");
    let folder = tempfile::tempdir().expect("a folder");
    let scenes = folder.path().join("pipelines/scenes");
    fs::create_dir_all(&scenes).expect("a folder");
    for entry in fs::read_dir(root().join("pipelines")).expect("lists").flatten() {
        if entry.path().is_file() {
            fs::copy(entry.path(), folder.path().join("pipelines").join(entry.file_name()))
                .expect("copies");
        }
    }
    let scene = read(&root().join("pipelines/scenes/quickstart.toml"));
    fs::write(scenes.join("quickstart.toml"), smaller(&scene)).expect("writes");

    let program = assert_cmd::cargo::cargo_bin!("sat3d");
    let path = std::env::join_paths(
        program
            .parent()
            .map(Path::to_path_buf)
            .into_iter()
            .chain(std::env::split_paths(&std::env::var_os("PATH").unwrap_or_default())),
    )
    .expect("a PATH");
    for block in commands {
        let output = Command::new("sh")
            .args(["-eu", "-c", &block])
            .current_dir(folder.path())
            .env("PATH", &path)
            .output()
            .expect("sh runs");
        assert!(
            output.status.success(),
            "{block}ends with {}\n{}{}",
            output.status,
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
    }
    // What the text promises beside the commands.
    let made = |pattern: &str| {
        let mut names = fs::read_dir(folder.path().join("dsm")).expect("dsm/ is there").flatten();
        names.any(|entry| entry.file_name().to_string_lossy().ends_with(pattern))
    };
    for name in ["_dsm.npz", ".png", "manifest.csv", "benchmark.json"] {
        assert!(made(name), "no {name} in dsm/");
    }
}

/// Targets of `[text](target)` in a text.
fn links(markdown: &str) -> Vec<String> {
    markdown
        .split("](")
        .skip(1)
        .filter_map(|rest| rest.split_once(')'))
        .map(|(target, _)| target.split('#').next().unwrap_or_default().to_owned())
        .collect()
}

#[test]
fn every_link_in_the_docs_leads_somewhere() {
    let mut pages: Vec<PathBuf> =
        ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"].map(|name| root().join(name)).into();
    let docs = fs::read_dir(root().join("docs")).expect("lists").flatten();
    pages.extend(docs.map(|entry| entry.path()).filter(|p| p.extension() == Some("md".as_ref())));
    let mut broken = Vec::new();
    for page in &pages {
        let folder = page.parent().expect("a page lies in a folder");
        for link in links(&read(page)) {
            if !link.is_empty() && !link.contains("://") && !folder.join(&link).exists() {
                broken.push(format!("{}: {link}", page.display()));
            }
        }
    }
    assert!(broken.is_empty(), "these links lead nowhere:\n{}", broken.join("\n"));
}

#[test]
fn the_index_lists_every_page() {
    let index = read(&root().join("docs/README.md"));
    for entry in fs::read_dir(root().join("docs")).expect("lists").flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.ends_with(".md") && name != "README.md" {
            assert!(index.contains(&format!("({name})")), "docs/README.md does not list {name}");
        }
    }
}
