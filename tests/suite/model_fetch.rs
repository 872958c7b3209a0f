//! `sat3d model fetch` against a small hub on this machine, and its cache against Python's library.
#![cfg(feature = "fetch")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::hub_support;

use hub_support::{Behaviour, COMMIT, Hub, NAME, git, sha256};
use sat3d::model::weights::WEIGHTS_FILE;
use sat3d::model::weights::rule::{tiny_overrides, write_checkpoint};
use serde_json::{Value, json};
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use tempfile::TempDir;

const CONFIG: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/crates/sat3d-model/fixtures/tiny/model/config.json");
const LICENCE: &str = "MIT License\n\nPermission is hereby granted\n";

/// A hub with the tiny checkpoint in `folder` of its repository, and an empty place for the cache.
struct World {
    hub: Hub,
    weights: Vec<u8>,
    root: TempDir,
}

impl World {
    fn new(folder: &str) -> Self {
        let root = tempfile::tempdir().unwrap();
        let made = root.path().join("made");
        write_checkpoint(&made, &fs::read_to_string(CONFIG).unwrap(), tiny_overrides()).unwrap();
        let weights = fs::read(made.join(WEIGHTS_FILE)).unwrap();
        let hub = Hub::new(
            vec![
                (".gitattributes".into(), b"*.safetensors filter=lfs\n".to_vec()),
                ("README.md".into(), b"---\nlicense: mit\n---\n# Weights\n".to_vec()),
                ("LICENSE".into(), LICENCE.into()),
                ("demo/large.safetensors".into(), vec![7; 1000]),
                (format!("{folder}config.json"), fs::read(made.join("config.json")).unwrap()),
                (format!("{folder}{WEIGHTS_FILE}"), weights.clone()),
            ],
            json!({"license": "mit"}),
        );
        Self { hub, weights, root }
    }

    fn cache(&self) -> PathBuf {
        self.root.path().join("hub")
    }

    fn repository(&self) -> PathBuf {
        self.cache().join("models--qian43--Sat3DGen")
    }

    fn snapshot(&self) -> PathBuf {
        self.repository().join("snapshots").join(COMMIT)
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sat3d"));
        for variable in [
            "SAT3D_LOG",
            "SAT3D_WEIGHTS",
            "HF_HOME",
            "HUGGINGFACE_HUB_CACHE",
            "HF_HUB_OFFLINE",
            "TRANSFORMERS_OFFLINE",
            "HF_HUB_DISABLE_SYMLINKS",
            "HUGGING_FACE_HUB_TOKEN",
            "SSL_CERT_FILE",
            "HTTP_PROXY",
            "http_proxy",
            "ALL_PROXY",
            "all_proxy",
        ] {
            command.env_remove(variable);
        }
        command
            .env("HF_ENDPOINT", &self.hub.endpoint)
            .env("HF_TOKEN", "secret")
            .env("HF_HUB_CACHE", self.cache())
            .stdin(Stdio::null())
            .args(["model"])
            .args(arguments);
        command
    }

    fn fetch(&self) -> Command {
        self.command(&["fetch", "--accept-license"])
    }

    /// The partial file of the weights.
    fn partial(&self) -> PathBuf {
        self.repository().join("blobs").join(format!("{}.incomplete", sha256(&self.weights)))
    }

    /// Whether the cache holds the checkpoint, whole, and nothing unfinished.
    fn is_whole(&self) {
        assert_eq!(fs::read(self.snapshot().join(WEIGHTS_FILE)).unwrap(), self.weights);
        assert_eq!(fs::read_to_string(self.repository().join("refs/main")).unwrap(), COMMIT);
        assert!(!self.partial().exists());
    }

    /// Whether nobody can take what is there for a checkpoint.
    fn is_nothing(&self) {
        assert!(!self.repository().join("refs").exists());
        assert!(!self.snapshot().join(WEIGHTS_FILE).exists());
    }
}

/// Standard output of a call that must end with `code`, and its standard error.
fn ran(command: &mut Command, code: i32) -> (String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (stdout, stderr) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert_eq!(status.code(), Some(code), "{stdout}\n{stderr}");
    (stdout, stderr)
}

#[test]
fn weights_are_fetched_into_the_layout_of_the_hub() {
    let world = World::new("");
    let (stdout, stderr) = ran(&mut world.fetch(), 0);
    assert!(
        stderr.contains("licence: mit in the repository's metadata; text in LICENSE"),
        "{stderr}"
    );
    assert!(stdout.contains("other commands find it by themselves"), "{stdout}");
    world.is_whole();
    let blobs = [("LICENSE", git(LICENCE.as_bytes())), (WEIGHTS_FILE, sha256(&world.weights))];
    for (name, etag) in blobs {
        let blob = world.repository().join("blobs").join(&etag);
        assert!(blob.is_file(), "{name}");
        #[cfg(unix)]
        {
            let link = fs::read_link(world.snapshot().join(name)).unwrap();
            assert_eq!(link, Path::new("../../blobs").join(&etag));
        }
        assert!(
            world.cache().join(format!(".locks/models--qian43--Sat3DGen/{etag}.lock")).exists()
        );
    }
    // Four files, and none of those that no checkpoint needs.
    assert_eq!(fs::read_dir(world.snapshot()).unwrap().count(), 4);
    assert_eq!(fs::read_dir(world.repository().join("blobs")).unwrap().count(), 4);
    // The token goes to the hub and to nobody else.
    let seen = world.hub.seen();
    assert!(seen.iter().any(|seen| seen.large));
    for seen in seen {
        let expected = (!seen.large).then_some("Bearer secret");
        assert_eq!(seen.authorization.as_deref(), expected, "{seen:?}");
    }

    // Again: everything is there, and was looked at.
    let (stdout, stderr) = ran(&mut world.command(&["fetch", "--json"]), 0);
    assert_eq!(stderr, "");
    let json: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(json["commit"], COMMIT);
    assert_eq!(json["licence"]["stated"], "mit");
    assert_eq!(json["folder"], world.snapshot().to_str().unwrap());
    let files = json["files"].as_array().unwrap();
    assert!(files.iter().all(|file| file["received"] == 0), "{stdout}");
    assert_eq!(files[3]["sha256"], sha256(&world.weights));
    assert!(!world.hub.seen().iter().any(|seen| seen.large));

    // The rest of the program finds it.
    let (stdout, _) = ran(&mut world.command(&["inspect", "--json"]), 0);
    let json: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(json["weights"]["origin"]["from"], "cache");
    assert_eq!(json["weights"]["origin"]["revision"], COMMIT);
    assert_eq!(json["inspection"]["parameters"], 1_168_563);
}

#[test]
fn a_checkpoint_in_a_subfolder_of_the_repository_is_found() {
    let world = World::new("training/vqmodel_ema/");
    ran(&mut world.fetch(), 0);
    #[cfg(unix)]
    {
        let link =
            fs::read_link(world.snapshot().join("training/vqmodel_ema/config.json")).unwrap();
        assert!(link.starts_with("../../../../blobs"), "{}", link.display());
    }
    let (stdout, _) = ran(&mut world.command(&["inspect"]), 0);
    assert!(stdout.contains("training/vqmodel_ema"), "{stdout}");
}

#[test]
fn nothing_is_fetched_before_the_licence_is_accepted() {
    let world = World::new("");
    let (_, stderr) = ran(&mut world.command(&["fetch"]), 2);
    for part in ["licence: mit", "---- LICENSE ----", "Permission is hereby", "--accept-license"] {
        assert!(stderr.contains(part), "{part} in {stderr}");
    }
    assert!(!world.cache().exists());
    assert!(!world.hub.seen().iter().any(|seen| seen.large));
}

#[test]
fn a_partial_file_is_continued() {
    let world = World::new("");
    let half = world.weights.len() / 2;
    fs::create_dir_all(world.partial().parent().unwrap()).unwrap();
    fs::write(world.partial(), &world.weights[..half]).unwrap();
    let (stdout, _) = ran(&mut world.fetch(), 0);
    assert!(stdout.contains("continued"), "{stdout}");
    world.is_whole();
    let ranges: Vec<_> = world.hub.seen().into_iter().filter(|seen| seen.large).collect();
    assert_eq!(ranges.len(), 1);
    assert_eq!(ranges[0].range, Some(format!("bytes={half}-")));
}

#[test]
fn a_broken_connection_a_deaf_server_and_a_damaged_part_end_well() {
    // Breaks twice in the middle, and is busy at first.
    let world = World::new("");
    let third = world.weights.len() / 3;
    world.hub.behave(Behaviour { cut: Some((third, 2)), busy: 2, ..Behaviour::default() });
    ran(&mut world.fetch(), 0);
    world.is_whole();
    let from: Vec<_> = world.hub.seen().into_iter().filter(|seen| seen.large).collect();
    let from: Vec<_> = from.into_iter().map(|seen| seen.range).collect();
    let at = |byte: usize| Some(format!("bytes={byte}-"));
    assert_eq!(from, [None, at(third), at(2 * third)]);

    // A server that knows no ranges sends the whole file.
    for damaged in [false, true] {
        let world = World::new("");
        fs::create_dir_all(world.partial().parent().unwrap()).unwrap();
        let mut part = world.weights[..third].to_vec();
        part[third / 2] ^= u8::from(damaged);
        fs::write(world.partial(), part).unwrap();
        // One that knows them continues what is damaged, which the hash finds.
        world.hub.behave(Behaviour { without_ranges: !damaged, ..Behaviour::default() });
        ran(&mut world.fetch(), 0);
        world.is_whole();
    }

    // More than the file is long, and a blob of the right length with wrong contents.
    let world = World::new("");
    fs::create_dir_all(world.partial().parent().unwrap()).unwrap();
    fs::write(world.partial(), vec![0; world.weights.len() + 1]).unwrap();
    let blob = world.repository().join("blobs").join(sha256(&world.weights));
    fs::write(&blob, vec![0; world.weights.len()]).unwrap();
    let (_, stderr) = ran(&mut world.fetch(), 0);
    assert!(
        stderr.contains("warning: in the cache") && stderr.contains("fetching it anew"),
        "{stderr}"
    );
    world.is_whole();
}

#[test]
fn wrong_contents_never_reach_the_cache() {
    let world = World::new("");
    world.hub.behave(Behaviour { damage: true, ..Behaviour::default() });
    let (_, stderr) = ran(&mut world.fetch(), 2);
    assert!(stderr.contains(&format!("the hub lists {}", sha256(&world.weights))), "{stderr}");
    assert!(stderr.contains("sha256 is"), "{stderr}");
    world.is_nothing();
    assert!(!world.partial().exists());
    let (stdout, _) = ran(&mut world.command(&["inspect"]), 0);
    assert!(stdout.contains("built-in:mini") && stdout.contains("sat3d model fetch"), "{stdout}");
    // A hub that is whole again.
    world.hub.behave(Behaviour::default());
    ran(&mut world.fetch(), 0);
    world.is_whole();
}

#[test]
fn what_the_server_refuses_is_said_in_words() {
    let world = World::new("");
    for (status, code, message, part) in [
        (401, "", "Invalid username", "no such repository, or a private one"),
        (401, "GatedRepo", "", "accept its conditions"),
        (403, "", "", "access has to be granted"),
        (404, "RepoNotFound", "", "check --repository; the token in HF_TOKEN may not read it"),
        (404, "RevisionNotFound", "", "name another with --revision"),
        (451, "", "Blocked here", "it says: Blocked here"),
    ] {
        let refuse = Some((status, code, message));
        world.hub.behave(Behaviour { refuse, ..Behaviour::default() });
        let (_, stderr) = ran(&mut world.fetch(), 2);
        assert!(stderr.contains(&format!("status {status}")), "{stderr}");
        assert!(stderr.contains(part) && stderr.contains(message), "{part} in {stderr}");
        assert!(!stderr.contains("secret"), "{stderr}");
    }
    let refuse = Some((404, "RepoNotFound", ""));
    world.hub.behave(Behaviour { refuse, ..Behaviour::default() });
    let (_, stderr) = ran(world.fetch().env_remove("HF_TOKEN"), 2);
    assert!(stderr.contains("no token was sent"), "{stderr}");
    assert!(!world.cache().exists());
}

#[test]
fn without_a_network_or_room_the_error_says_what_to_do() {
    let world = World::new("");
    // A port that nobody listens on.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let closed = format!("http://127.0.0.1:{port}");
    let (_, stderr) = ran(world.fetch().env("HF_ENDPOINT", &closed), 2);
    for part in [closed.as_str(), "when the network is there", "--weights", "HF_ENDPOINT"] {
        assert!(stderr.contains(part), "{part} in {stderr}");
    }
    let (_, stderr) = ran(world.fetch().env("HF_ENDPOINT", "hub.example"), 2);
    assert!(stderr.contains("HF_ENDPOINT `hub.example`: has to begin with"), "{stderr}");
    let (_, stderr) = ran(world.fetch().env("HF_HUB_OFFLINE", "1"), 2);
    assert!(stderr.contains("HF_HUB_OFFLINE is set"), "{stderr}");
    let (_, stderr) = ran(world.fetch().env("HF_TOKEN", "se cret"), 2);
    assert!(stderr.contains("HF_TOKEN") && !stderr.contains("se cret"), "{stderr}");
    let (_, stderr) = ran(world.fetch().args(["--repository", "../x"]), 2);
    assert!(stderr.contains("a repository is OWNER/NAME"), "{stderr}");
    assert!(world.hub.seen().is_empty());
    #[cfg(unix)]
    {
        let stated_size = Some(1 << 60);
        world.hub.behave(Behaviour { stated_size, ..Behaviour::default() });
        let (_, stderr) = ran(&mut world.fetch(), 2);
        assert!(stderr.contains("are free; make room, or name another cache"), "{stderr}");
        world.is_nothing();
    }
}

#[test]
fn two_fetches_at_once_download_once() {
    let world = World::new("");
    let slow = Some(Duration::from_millis(20));
    world.hub.behave(Behaviour { slow, ..Behaviour::default() });
    let start = || world.fetch().stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let both = [start(), start()].map(|child| child.wait_with_output().unwrap());
    for output in &both {
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{stderr}");
    }
    world.is_whole();
    assert_eq!(world.hub.seen().iter().filter(|seen| seen.large).count(), 1);
}

#[cfg(unix)]
#[test]
fn an_interrupted_fetch_continues() {
    let world = World::new("");
    let slow = Some(Duration::from_millis(100));
    world.hub.behave(Behaviour { slow, ..Behaviour::default() });
    let child = world.fetch().stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // Once something of the weights has arrived.
    for _ in 0..600 {
        if fs::metadata(world.partial()).is_ok_and(|data| data.len() > 0) {
            break;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let kill = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(kill.unwrap().success());
    let output = child.wait_with_output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{stderr}");
    assert!(stderr.contains("the same command continues"), "{stderr}");
    world.is_nothing();
    let part = fs::metadata(world.partial()).unwrap().len();
    assert!(part > 0 && part < world.weights.len() as u64, "{part}");
    world.hub.seen();
    world.hub.behave(Behaviour::default());
    ran(&mut world.fetch(), 0);
    world.is_whole();
    let seen = world.hub.seen();
    let large = seen.iter().find(|seen| seen.large).unwrap();
    assert_eq!(large.range, Some(format!("bytes={part}-")));
}

#[test]
fn without_links_the_snapshot_holds_the_files_themselves() {
    let world = World::new("");
    ran(world.fetch().env("HF_HUB_DISABLE_SYMLINKS", "1"), 0);
    world.is_whole();
    let name = world.snapshot().join(WEIGHTS_FILE);
    assert!(fs::symlink_metadata(&name).unwrap().is_file());
    assert_eq!(fs::read_dir(world.repository().join("blobs")).unwrap().count(), 0);
    world.hub.seen();
    let (stdout, _) = ran(world.fetch().env("HF_HUB_DISABLE_SYMLINKS", "1"), 0);
    assert_eq!(stdout.matches("was there").count(), 4, "{stdout}");
    assert!(!world.hub.seen().iter().any(|seen| seen.large));
}

/// Python with `huggingface_hub`, or a line that says that there is none.
fn python(test: &str) -> Option<std::ffi::OsString> {
    let named = ["SAT3D_TEST_PYTHON", "SAT3D_PYTHON"].iter().find_map(std::env::var_os);
    let interpreter = named.unwrap_or_else(|| "python3".into());
    let has = Command::new(&interpreter).args(["-c", "import huggingface_hub"]).output();
    if has.is_ok_and(|output| output.status.success()) {
        return Some(interpreter);
    }
    let why = "no python with huggingface_hub (set SAT3D_TEST_PYTHON)";
    // The test harness hides what `eprintln!` says; this reaches the terminal.
    let _ = writeln!(std::io::stderr(), "SKIPPED {test}: {why}");
    None
}

#[test]
fn pythons_library_finds_what_was_fetched() {
    const SCRIPT: &str = r#"
import json, sys
from huggingface_hub import constants, scan_cache_dir, snapshot_download, try_to_load_from_cache
name, weights = sys.argv[1:]
info = scan_cache_dir()
print(json.dumps({
    "cache": constants.HF_HUB_CACHE,
    "snapshot": snapshot_download(name, local_files_only=True),
    "weights": try_to_load_from_cache(name, weights),
    "repositories": [repo.repo_id for repo in info.repos],
    "refs": [sorted(revision.refs) for repo in info.repos for revision in repo.revisions],
    "files": sum(len(r.files) for repo in info.repos for r in repo.revisions),
    "warnings": [str(warning) for warning in info.warnings],
}))"#;
    let Some(interpreter) = python("pythons_library_finds_what_was_fetched") else { return };
    for links in [true, false] {
        let world = World::new("");
        let disable = if links { "0" } else { "1" };
        ran(world.fetch().env("HF_HUB_DISABLE_SYMLINKS", disable), 0);
        let output = Command::new(&interpreter)
            .args(["-c", SCRIPT, NAME, WEIGHTS_FILE])
            .env("HF_HUB_CACHE", world.cache())
            .env("HF_HUB_OFFLINE", "1")
            .output()
            .unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        let found: Value = serde_json::from_slice(&output.stdout).expect(&stderr);
        assert_eq!(found["snapshot"], world.snapshot().to_str().unwrap());
        assert_eq!(found["weights"], world.snapshot().join(WEIGHTS_FILE).to_str().unwrap());
        assert_eq!(found["repositories"], json!([NAME]));
        assert_eq!(found["refs"], json!([["main"]]));
        assert_eq!(found["files"], 4);
        assert_eq!(found["warnings"], json!([]), "links: {links}");
    }
}

/// The error of a cache without weights names the folder that was looked into.
#[test]
fn the_cache_is_where_pythons_library_has_it() {
    let Some(interpreter) = python("the_cache_is_where_pythons_library_has_it") else { return };
    let home = tempfile::tempdir().unwrap();
    for set in [
        &[][..],
        &[("XDG_CACHE_HOME", "/x")],
        &[("XDG_CACHE_HOME", "/x"), ("HF_HOME", "/h")],
        &[("HF_HOME", "/h"), ("HUGGINGFACE_HUB_CACHE", "/old")],
        &[("HUGGINGFACE_HUB_CACHE", "/old"), ("HF_HUB_CACHE", "/new")],
        &[("HF_HUB_CACHE", "~/c")],
        &[("HF_HOME", "~"), ("X", "1")],
        &[("HF_HOME", "$X/${Y_1}/$NONE/$"), ("X", "/a"), ("Y_1", "b")],
        &[("HF_HUB_CACHE", "/a${X}b$X-c"), ("X", "1")],
    ] {
        let clean = |program: &std::ffi::OsStr| {
            let mut command = Command::new(program);
            command.env_clear().envs(std::env::var_os("PATH").map(|path| ("PATH", path)));
            command.env("HOME", home.path()).envs(set.iter().copied());
            command
        };
        let script = "from huggingface_hub import constants; print(constants.HF_HUB_CACHE, end='')";
        let output = clean(&interpreter).args(["-c", script]).output().unwrap();
        let expected = String::from_utf8(output.stdout).unwrap();
        assert!(!expected.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
        let ours = clean(env!("CARGO_BIN_EXE_sat3d").as_ref()).args(["model", "inspect"]).output();
        let stderr = String::from_utf8(ours.unwrap().stderr).unwrap();
        let looked = format!("({expected}/models--qian43--Sat3DGen/refs/main does not exist)");
        assert!(stderr.contains(&looked), "{looked} in {stderr}");
    }
}
