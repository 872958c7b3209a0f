//! Checkpoints on disk: whole, damaged, too many.

use super::*;
use serde_json::json;

fn tensor(name: &str, values: &[f32]) -> NamedTensor {
    NamedTensor { name: name.into(), shape: vec![values.len()], values: values.to_vec() }
}

fn exported() -> Exported {
    let config = "{\"a\": 1}".to_owned();
    Exported {
        config,
        model: vec![tensor("w", &[1.0, 2.0])],
        average: vec![tensor("w", &[0.5, 1.5])],
    }
}

fn description(step: u64) -> Description {
    let settings = json!({ "run": { "seed": 7 } });
    Description {
        format: 0,
        software: "sat3d test".into(),
        step,
        seed: 7,
        settings_hash: settings_hash(&settings),
        settings,
        log_bytes: 12,
        progress: Progress::default(),
        files: Vec::new(),
    }
}

fn store(out: &Path, step: u64) -> PathBuf {
    let state = [
        tensor("m", &[0.25; 8]),
        NamedTensor { name: "t".into(), shape: vec![], values: vec![3.0] },
    ];
    write(out, description(step), &exported(), &state).expect("writes")
}

#[test]
fn what_is_written_is_read_and_the_same_bytes_come_again() {
    let out = tempfile::tempdir().expect("a folder");
    assert!(newest(out.path()).expect("lists").is_none());
    store(out.path(), 9);
    let folder = store(out.path(), 10);
    let stored = newest(out.path()).expect("lists").expect("one");
    assert_eq!((stored.folder.as_path(), stored.description.step), (folder.as_path(), 10));
    assert_eq!(stored.description.files.len(), 5);
    let state = read_tensors(&folder.join(STATE)).expect("reads");
    assert_eq!(state.iter().map(|t| t.name.as_str()).collect::<Vec<_>>(), ["m", "t"]);
    assert_eq!(state[1], NamedTensor { name: "t".into(), shape: vec![], values: vec![3.0] });
    let average = read_tensors(&folder.join("vqmodel_ema").join(WEIGHTS_FILE)).expect("reads");
    assert_eq!(average, exported().average);
    // Where `sat3d infer --weights checkpoint-10` looks.
    let place = crate::model::weights::locate(&folder).expect("is one");
    assert!(place.ends_with("vqmodel_ema"));
    let files = |folder: &Path| -> Vec<Vec<u8>> {
        let names = stored.description.files.iter().map(|file| file.file.as_str());
        names.chain([DESCRIPTION]).map(|n| std::fs::read(folder.join(n)).expect("reads")).collect()
    };
    let first = files(&folder);
    assert_eq!(files(&store(out.path(), 10)), first);
}

#[cfg(unix)]
#[test]
fn others_may_read_the_files() {
    use std::os::unix::fs::PermissionsExt as _;
    let out = tempfile::tempdir().expect("a folder");
    let folder = store(out.path(), 1);
    let mode =
        |file: &str| std::fs::metadata(folder.join(file)).expect("is there").permissions().mode();
    assert_eq!(mode(STATE) & 0o777, mode(DESCRIPTION) & 0o777);
}

#[test]
fn a_damaged_checkpoint_is_passed_over_for_an_older_one() {
    let out = tempfile::tempdir().expect("a folder");
    store(out.path(), 10);
    let damages: [fn(&Path); 4] = [
        |folder| std::fs::remove_file(folder.join(STATE)).expect("is there"),
        |folder| {
            let file = folder.join("vqmodel").join(WEIGHTS_FILE);
            let mut bytes = std::fs::read(&file).expect("reads");
            *bytes.last_mut().expect("some") ^= 1;
            std::fs::write(&file, bytes).expect("writes");
        },
        |folder| std::fs::write(folder.join(DESCRIPTION), "{").expect("writes"),
        |folder| {
            let text = std::fs::read_to_string(folder.join(DESCRIPTION)).expect("reads");
            let other = text.replace("\"format\": 1", "\"format\": 2");
            std::fs::write(folder.join(DESCRIPTION), other).expect("writes");
        },
    ];
    for damage in damages {
        let folder = store(out.path(), 20);
        assert_eq!(newest(out.path()).expect("lists").expect("one").description.step, 20);
        damage(&folder);
        assert_eq!(newest(out.path()).expect("lists").expect("one").description.step, 10);
    }
}

#[test]
fn only_the_last_are_kept() {
    let out = tempfile::tempdir().expect("a folder");
    for step in [5, 100, 20, 3] {
        store(out.path(), step);
    }
    std::fs::create_dir(out.path().join("checkpoint-last")).expect("makes");
    prune(out.path(), 0);
    assert_eq!(list(out.path()).expect("lists"), [100, 20, 5, 3]);
    prune(out.path(), 2);
    assert_eq!(list(out.path()).expect("lists"), [100, 20]);
    assert_eq!(std::fs::read_dir(out.path()).expect("lists").count(), 3);
}

#[test]
fn a_list_that_is_no_list_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.safetensors");
    let twice = [tensor("a", &[1.0]), tensor("a", &[2.0])];
    assert!(
        write_tensors(&path, &twice).expect_err("twice").to_string().contains("`a` comes twice")
    );
    let odd = NamedTensor { shape: vec![2, 2], ..tensor("b", &[1.0]) };
    assert!(write_tensors(&path, &[odd]).expect_err("odd").to_string().contains("`b`"));
    assert!(!path.exists());
}
