use super::*;
use std::collections::BTreeMap;
use std::fs;

fn checkpoint(folder: &Path) {
    fs::create_dir_all(folder).expect("a folder");
    fs::write(folder.join("config.json"), "{}").expect("writes");
    fs::write(folder.join(WEIGHTS_FILE), "").expect("writes");
}

fn found(argument: Option<&Path>, set: &[(&str, &Path)]) -> Result<Weights, WeightsError> {
    let set: BTreeMap<&str, OsString> =
        set.iter().map(|(name, path)| (*name, path.as_os_str().to_owned())).collect();
    find_in(argument, &|name| set.get(name).cloned())
}

const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";

/// A cache with the repository at [`COMMIT`], with a checkpoint in `subfolder`.
fn cache(folder: &Path, subfolder: &str) -> PathBuf {
    let repository = folder.join("models--qian43--Sat3DGen");
    fs::create_dir_all(repository.join("refs")).expect("a folder");
    fs::write(repository.join("refs/main"), COMMIT).expect("writes");
    let snapshot = repository.join("snapshots").join(COMMIT);
    checkpoint(&snapshot.join(subfolder));
    snapshot
}

#[test]
fn the_argument_counts_before_the_variable_and_that_before_the_cache() {
    let root = tempfile::tempdir().expect("a folder");
    let (a, b, c) = (root.path().join("a"), root.path().join("b"), root.path().join("c"));
    checkpoint(&a);
    checkpoint(&b);
    let snapshot = cache(&c, "");
    let all = [(VARIABLE, b.as_path()), ("HF_HUB_CACHE", c.as_path())];
    let weights = found(Some(&a), &all).expect("found");
    assert_eq!(weights, Weights { folder: a.clone(), origin: Origin::Argument });
    let weights = found(None, &all).expect("found");
    assert_eq!(weights, Weights { folder: b, origin: Origin::Environment });
    let of_cache = Origin::Cache { repository: REPOSITORY.into(), revision: COMMIT.into() };
    for variable in [Path::new(""), &c] {
        let set = [(VARIABLE, Path::new("")), ("HF_HUB_CACHE", c.as_path()), ("X", variable)];
        let weights = found(None, &set).expect("found");
        assert_eq!(weights, Weights { folder: snapshot.clone(), origin: of_cache.clone() });
    }
    let json = serde_json::to_string(&of_cache).expect("serialises");
    assert_eq!(
        json,
        format!(r#"{{"from":"cache","repository":"qian43/Sat3DGen","revision":"{COMMIT}"}}"#)
    );
    assert_eq!(serde_json::from_str::<Origin>(&json).expect("reads"), of_cache);
}

#[test]
fn a_place_without_a_checkpoint_is_never_passed_over() {
    let root = tempfile::tempdir().expect("a folder");
    let (empty, good) = (root.path().join("empty"), root.path().join("good"));
    fs::create_dir_all(&empty).expect("a folder");
    checkpoint(&good);
    let error = found(Some(&empty), &[(VARIABLE, &good)]).expect_err("refused");
    let text = error.to_string();
    assert!(matches!(error, WeightsError::NotHere { by: "--weights", .. }), "{text}");
    assert!(text.contains("no config.json in it") && text.contains(WEIGHTS_FILE), "{text}");
    let cached = root.path().join("cache");
    cache(&cached, "");
    let error = found(None, &[(VARIABLE, &empty), ("HF_HUB_CACHE", &cached)]).expect_err("refused");
    assert!(matches!(error, WeightsError::NotHere { by: "SAT3D_WEIGHTS", .. }), "{error}");
    let error = found(Some(&root.path().join("nowhere")), &[]).expect_err("refused").to_string();
    assert!(error.contains("there is no such folder"), "{error}");
}

#[test]
fn the_model_inside_the_program_comes_last_or_by_its_name() {
    let root = tempfile::tempdir().expect("a folder");
    let nothing = found(None, &[("HF_HUB_CACHE", root.path())]);
    let weights = or_built_in(nothing).expect("always there");
    let origin = Origin::BuiltIn { name: "mini".into() };
    assert_eq!(weights, Weights { folder: "built-in:mini".into(), origin: origin.clone() });
    assert_eq!(weights.open().expect("opens").config().class_name, "Sat3DMini");
    let note = weights.note().expect("a note");
    assert!(note.contains("sat3d model fetch") && note.contains("indicative"), "{note}");
    let good = root.path().join("good");
    checkpoint(&good);
    let named = Path::new("built-in:mini");
    assert_eq!(found(Some(named), &[(VARIABLE, &good)]).expect("found").origin, origin);
    assert_eq!(found(None, &[(VARIABLE, named)]).expect("found").origin, origin);
    assert_eq!(found(Some(&good), &[(VARIABLE, named)]).expect("found").note(), None);
    let error = found(Some(Path::new("built-in:maxi")), &[]).expect_err("refused").to_string();
    assert!(error.contains("built-in:maxi") && error.contains("no such folder"), "{error}");
    // What a manifest holds.
    let json = serde_json::to_string(&origin).expect("serialises");
    assert_eq!(json, r#"{"from":"built_in","name":"mini"}"#);
    assert_eq!(serde_json::from_str::<Origin>(&json).expect("reads"), origin);
}

#[test]
fn checkpoints_are_found_below_a_place_and_several_are_listed() {
    let root = tempfile::tempdir().expect("a folder");
    let at = |place: &str| root.path().join(place);
    checkpoint(&at("one/run/checkpoint-9/vqmodel"));
    checkpoint(&at("one/run/checkpoint-9/vqmodel_ema"));
    checkpoint(&at("one/.hidden"));
    let folder = |place: &str| found(Some(&at(place)), &[]).map(|weights| weights.folder);
    let averaged = at("one/run/checkpoint-9/vqmodel_ema");
    for place in ["one/run/checkpoint-9", "one/run", "one"] {
        assert_eq!(folder(place).expect("found"), averaged, "{place}");
    }
    // A file of the folder stands for it.
    for file in ["config.json", WEIGHTS_FILE] {
        assert_eq!(
            folder(&format!("one/run/checkpoint-9/vqmodel_ema/{file}")).expect("found"),
            averaged
        );
    }
    // Three levels are too deep.
    assert!(matches!(folder("."), Err(WeightsError::NotHere { .. })));
    checkpoint(&at("one/run/checkpoint-10/vqmodel"));
    let error = folder("one/run").expect_err("refused");
    let text = error.to_string();
    assert!(matches!(error, WeightsError::Several { .. }), "{text}");
    assert!(text.contains("checkpoint-10/vqmodel\n") && text.ends_with("checkpoint-9/vqmodel_ema"));
}

#[test]
fn the_cache_says_what_it_lacks() {
    let root = tempfile::tempdir().expect("a folder");
    let place = root.path();
    let error = found(None, &[("HF_HUB_CACHE", place)]).expect_err("nothing there").to_string();
    for part in ["sat3d model fetch", "--weights", "SAT3D_WEIGHTS", "refs/main does not exist"] {
        assert!(error.contains(part), "{part} in {error}");
    }
    let snapshot = cache(place, "weights");
    let weights = found(None, &[("HF_HUB_CACHE", place)]).expect("found in a subfolder");
    assert_eq!(weights.folder, snapshot.join("weights"));
    // The folder of the repository can be named, too.
    let repository = place.join("models--qian43--Sat3DGen");
    assert_eq!(found(Some(&repository), &[]).expect("found").folder, weights.folder);
    fs::remove_file(snapshot.join("weights").join(WEIGHTS_FILE)).expect("removes");
    let error = found(None, &[("HF_HUB_CACHE", place)]).expect_err("half");
    assert!(matches!(error, WeightsError::Incomplete { .. }), "{error}");
    assert!(error.to_string().contains("completes it"), "{error}");
    fs::write(repository.join("refs/main"), "../../elsewhere").expect("writes");
    let error = found(None, &[("HF_HUB_CACHE", place)]).expect_err("no commit").to_string();
    assert!(error.contains("refs/main") && error.contains("is no commit"), "{error}");
}

/// The cases of `huggingface_hub`'s own order; the same list is run through it in
/// `tests/suite/model_fetch.rs`.
#[test]
fn the_cache_is_where_the_python_library_has_it() {
    for (set, expected) in [
        (&[][..], "/home/u/.cache/huggingface/hub"),
        (&[("XDG_CACHE_HOME", "/x")], "/x/huggingface/hub"),
        (&[("XDG_CACHE_HOME", "/x"), ("HF_HOME", "/h")], "/h/hub"),
        (&[("HF_HOME", "/h"), ("HUGGINGFACE_HUB_CACHE", "/old")], "/old"),
        (&[("HUGGINGFACE_HUB_CACHE", "/old"), ("HF_HUB_CACHE", "/new")], "/new"),
        (&[("HF_HUB_CACHE", "~/c")], "/home/u/c"),
        (&[("HF_HOME", "~"), ("X", "1")], "/home/u/hub"),
        (&[("HF_HOME", "$X/${Y_1}/$NONE/$"), ("X", "/a"), ("Y_1", "b")], "/a/b/$NONE/$/hub"),
        (&[("HF_HUB_CACHE", "/a${X}b$X-c"), ("X", "1")], "/a1b1-c"),
    ] {
        let get = |name: &str| match name {
            "HOME" => Some(OsString::from("/home/u")),
            _ => set.iter().find(|(key, _)| *key == name).map(|(_, value)| OsString::from(value)),
        };
        let cache = Cache::from_variables(&get).expect("a home is known");
        assert_eq!(cache.folder(), Path::new(expected), "{set:?}");
    }
}
