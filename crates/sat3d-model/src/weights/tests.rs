#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::rule::{RuleWeights, full_overrides, tiny_overrides, write_checkpoint};
use super::*;
use half::{bf16, f16};
use safetensors::tensor::{Dtype, TensorView};
use std::collections::BTreeMap;

const TINY: &str = include_str!("../../fixtures/tiny/model/config.json");
const TENSORS: &str = include_str!("../../fixtures/tensors.tsv");

/// Tensors of a file under construction: type, shape, bytes.
type Tensors = BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>;

fn tiny_tensors() -> Tensors {
    let config = Config::from_json(TINY).unwrap();
    let weights = RuleWeights::new(&config, tiny_overrides());
    let mut tensors = Tensors::new();
    for spec in expected(&config) {
        let values = weights.values(&spec.key, &spec.shape);
        let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        tensors.insert(spec.key, (Dtype::F32, spec.shape, bytes));
    }
    tensors
}

fn written(tensors: &Tensors, config: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("config.json"), config).unwrap();
    let views = tensors.iter().map(|(key, (dtype, shape, bytes))| {
        (key, TensorView::new(*dtype, shape.clone(), bytes).unwrap())
    });
    safetensors::serialize_to_file(views, None, &folder.path().join(WEIGHTS_FILE)).unwrap();
    folder
}

fn tiny_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_checkpoint(folder.path(), TINY, tiny_overrides()).unwrap();
    folder
}

fn mismatch(error: ModelError) -> Mismatch {
    match error {
        ModelError::Tensors { mismatch, .. } => *mismatch,
        other => panic!("{other}"),
    }
}

#[test]
fn the_release_has_the_published_list_of_tensors() {
    let released = Config::released();
    let listed: BTreeMap<String, Vec<usize>> = TENSORS
        .lines()
        .skip(1)
        .map(|line| {
            let mut fields = line.split('\t');
            let key = fields.next().unwrap().to_owned();
            (key, serde_json::from_str(fields.next().unwrap()).unwrap())
        })
        .collect();
    let specs = expected(&released);
    let made: BTreeMap<String, Vec<usize>> = specs
        .iter()
        .filter(|spec| spec.key != "point_representer.triplane_axes")
        .map(|spec| (spec.key.clone(), spec.shape.clone()))
        .collect();
    assert_eq!(made, listed);
    let parameters: usize =
        specs.iter().filter(|spec| spec.need != Need::Buffer).map(TensorSpec::values).sum();
    assert_eq!(parameters, 381_022_223);
}

/// First and last value of tensors of each kind of the rule, in the full network. Computed in
/// NumPy by the published rule.
#[test]
fn the_rule_gives_the_published_values() {
    let config = Config::released();
    let weights = RuleWeights::new(&config, full_overrides());
    let specs = expected(&config);
    for (key, first, last) in [
        ("unet_model.dino_model.embeddings.cls_token", 0xbb5c_7099, 0xbc60_3fc4),
        ("unet_model.dino_model.layer.23.mlp.up_proj.weight", 0xbb9d_cad6, 0x3ccb_ed11),
        ("unet_model.dino_model.layer.7.layer_scale2.lambda1", 0x3dfa_8768, 0x3de6_d845),
        ("unet_model.decoder.up.0.block.0.nin_shortcut.bias", 0xbd31_8cf3, 0x3d64_21c3),
        ("unet_model.decoder.norm_out.weight", 0x3f6c_d7f8, 0x3f7f_9faa),
        ("unet_model.decoder.conv_in.weight", 0x3bba_253f, 0x3c56_751c),
        ("mlp.net1_density.weight", 0x405e_11d2, 0x3f91_0554),
        ("mlp.net1_density.bias", 0xc0f0_0000, 0xc0f0_0000),
        ("sr_module.block1.toRGB.weight", 0x3c15_a2b4, 0xbb90_bfeb),
        ("sky_mapping.mapping.0.weight", 0x3fe6_478a, 0xbfb5_081c),
    ] {
        let spec = specs.iter().find(|spec| spec.key == key).unwrap();
        let values = weights.values(key, &spec.shape);
        let ends = [values[0], values[values.len() - 1]].map(f32::to_bits);
        assert_eq!(ends, [first, last], "{key}");
    }
}

#[test]
fn a_written_checkpoint_is_read_and_described() {
    let folder = tiny_folder();
    let checkpoint = Checkpoint::open(folder.path()).unwrap();
    let inspection = inspect(&checkpoint);
    assert_eq!(inspection.parameters, 1_168_563);
    assert_eq!(inspection.class_name, "Sat3DGen");
    assert_eq!(inspection.buffers, ["point_representer.oneplane_axes"]);
    assert!(inspection.absent.is_empty());
    let modules: Vec<(&str, usize, u64, &str)> = inspection
        .modules
        .iter()
        .map(|module| {
            let hash = module.sha256.get(..16).unwrap();
            (module.name.as_str(), module.tensors, module.parameters, hash)
        })
        .collect();
    // Hashes of the file that the reference saved, by the recipe of `ModuleSummary::sha256`.
    assert_eq!(
        modules,
        [
            ("unet_model.dino_model", 58, 199_872, "e81426ad61d6c8ee"),
            ("unet_model.decoder", 160, 381_040, "36f9f25e0cd72cde"),
            ("mlp", 10, 1_897, "0591da5820bdd4d6"),
            ("sky_mapping", 4, 81_842, "571274ea08a10717"),
            ("sky_decoder", 74, 495_592, "42719485aa937bc8"),
            ("sr_module", 11, 8_320, "8adab1126479fc8f"),
        ]
    );
    let bytes = std::fs::read(folder.path().join(WEIGHTS_FILE)).unwrap();
    assert_eq!(inspection.bytes, bytes.len() as u64);
    // The same tensors give the same modules, whatever the layout of the file.
    let other = written(&tiny_tensors(), TINY);
    let other = inspect(&Checkpoint::open(other.path()).unwrap());
    assert_ne!(other.sha256, inspection.sha256);
    assert_eq!(other.modules, inspection.modules);
}

#[test]
fn training_checkpoints_are_found_inside_averaged_first() {
    let root = tempfile::tempdir().unwrap();
    write_checkpoint(&root.path().join("vqmodel"), TINY, Vec::new()).unwrap();
    assert_eq!(locate(root.path()).unwrap(), root.path().join("vqmodel"));
    write_checkpoint(&root.path().join("vqmodel_ema"), TINY, tiny_overrides()).unwrap();
    let checkpoint = Checkpoint::open(root.path()).unwrap();
    assert_eq!(checkpoint.folder(), root.path().join("vqmodel_ema"));
    let bias = checkpoint.read("mlp.net1_density.bias", &[1]).unwrap();
    assert_eq!(bias, [-4.5]);
}

#[test]
fn folders_without_a_checkpoint_say_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let text = |path: &Path| Checkpoint::open(path).unwrap_err().to_string();
    assert!(text(&folder.path().join("none")).contains("not a folder"));
    assert!(text(folder.path()).contains("no config.json in it, nor in vqmodel_ema or vqmodel"));
    std::fs::write(folder.path().join("config.json"), TINY).unwrap();
    assert!(text(folder.path()).contains("has no diffusion_pytorch_model.safetensors"));
}

#[test]
fn all_wrong_tensors_are_listed_in_one_error() {
    let mut tensors = tiny_tensors();
    tensors.remove("mlp.net0.bias");
    tensors.remove("sky_decoder.conv_in.weight");
    tensors.insert("unet_model.extra.weight".into(), (Dtype::F32, vec![1], vec![0; 4]));
    tensors.insert("mlp.style_squ.bias".into(), (Dtype::F32, vec![8, 2], vec![0; 64]));
    tensors.insert("mlp.net1_density.bias".into(), (Dtype::I32, vec![1], vec![0; 4]));
    let folder = written(&tensors, TINY);
    let error = Checkpoint::open(folder.path()).unwrap_err();
    let text = error.to_string();
    for part in [
        "2 missing: ",
        "mlp.net0.bias",
        "sky_decoder.conv_in.weight",
        "1 extra: unet_model.extra.weight",
        "mlp.style_squ.bias: expected [16], found [8, 2]",
        "mlp.net1_density.bias: I32",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
    let found = mismatch(error);
    assert_eq!((found.missing.len(), found.extra.len()), (2, 1));
    assert_eq!((found.misshaped.len(), found.mistyped.len()), (1, 1));
}

#[test]
fn what_may_be_absent_or_left_over_is_let_be() {
    let mut tensors = tiny_tensors();
    tensors.retain(|key, _| !key.starts_with("point_representer.") && !key.ends_with("mask_token"));
    assert!(Checkpoint::open(written(&tensors, TINY).path()).is_ok());

    let without = TINY.replace("\"sr_factor\": 2", "\"sr_factor\": 1");
    assert_ne!(without, TINY);
    let left_over = written(&tiny_tensors(), &without);
    assert!(Checkpoint::open(left_over.path()).is_ok());
    let mut tensors = tiny_tensors();
    tensors.retain(|key, _| !key.starts_with("sr_module."));
    let folder = written(&tensors, &without);
    let inspection = inspect(&Checkpoint::open(folder.path()).unwrap());
    assert_eq!(inspection.absent.len(), 11);
    // With super-resolution they must be there.
    let error = Checkpoint::open(written(&tensors, TINY).path()).unwrap_err();
    assert_eq!(mismatch(error).missing.len(), 11);
}

#[test]
fn another_config_finds_other_shapes() {
    let folder = written(&tiny_tensors(), &TINY.replace("\"dim\": 8", "\"dim\": 16"));
    let found = mismatch(Checkpoint::open(folder.path()).unwrap_err());
    let keys: Vec<&str> = found.misshaped.iter().map(|(key, ..)| key.as_str()).collect();
    assert_eq!(
        keys,
        [
            "unet_model.decoder.conv_out.weight",
            "unet_model.decoder.conv_out.bias",
            "mlp.net0.weight"
        ]
    );
}

#[test]
fn damaged_files_are_refused() {
    let folder = tiny_folder();
    let path = folder.path().join(WEIGHTS_FILE);
    let whole = std::fs::read(&path).unwrap();
    let header = 8 + usize::try_from(u64::from_le_bytes(whole[..8].try_into().unwrap())).unwrap();
    // Nothing, less than a length, inside the header, before the first tensor, before the last byte.
    for length in [0, 5, 8, header / 2, header, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        let error = Checkpoint::open(folder.path()).unwrap_err();
        let text = error.to_string();
        assert!(matches!(error, ModelError::Damaged { .. }), "{length}: {text}");
        assert!(text.contains(&format!("{length} bytes")), "{length}: {text}");
    }
    let mut longer = whole.clone();
    longer.push(0);
    std::fs::write(&path, longer).unwrap();
    assert!(Checkpoint::open(folder.path()).unwrap_err().to_string().contains("too long"));
    assert!(matches!(Checkpoint::open(folder.path()), Err(ModelError::Damaged { .. })));
    // Not safetensors at all; and a header that lies about its own length.
    let mut lying = whole.clone();
    lying[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    for bytes in [b"PK\x03\x04 this is a zip file, not tensors".to_vec(), lying] {
        std::fs::write(&path, bytes).unwrap();
        let error = Checkpoint::open(folder.path()).unwrap_err();
        assert!(matches!(error, ModelError::Damaged { .. }), "{error}");
    }
    std::fs::write(&path, &whole).unwrap();
    assert!(Checkpoint::open(folder.path()).is_ok());
}

#[test]
fn another_class_is_refused() {
    let folder = tiny_folder();
    let config = TINY.replace("\"Sat3DGen\"", "\"AutoencoderKL\"");
    std::fs::write(folder.path().join("config.json"), config).unwrap();
    let error = Checkpoint::open(folder.path()).unwrap_err();
    assert!(matches!(error, ModelError::ClassName { .. }), "{error}");
    assert!(error.to_string().contains("config.json"), "{error}");
}

#[test]
fn half_precision_is_widened_exactly() {
    let mut tensors = tiny_tensors();
    let values = [1.0_f32, -0.333_251_95, 65504.0, 6.1e-5];
    for (key, dtype) in
        [("sr_module.block0.conv0.conv.bias", Dtype::F16), ("mlp.net1_feature.bias", Dtype::BF16)]
    {
        let (_, shape, _) = tensors[key].clone();
        let bytes = (0..shape[0])
            .flat_map(|index| {
                let value = values[index % values.len()];
                match dtype {
                    Dtype::F16 => f16::from_f32(value).to_le_bytes(),
                    _ => bf16::from_f32(value).to_le_bytes(),
                }
            })
            .collect();
        tensors.insert(key.into(), (dtype, shape, bytes));
    }
    let folder = written(&tensors, TINY);
    let checkpoint = Checkpoint::open(folder.path()).unwrap();
    let read = checkpoint.read("sr_module.block0.conv0.conv.bias", &[16]).unwrap();
    assert_eq!(read[..4], values.map(|value| f16::from_f32(value).to_f32()));
    let read = checkpoint.read("mlp.net1_feature.bias", &[16]).unwrap();
    assert_eq!(read[..4], values.map(|value| bf16::from_f32(value).to_f32()));
    assert_eq!(inspect(&checkpoint).modules.last().unwrap().elements, ["F16", "F32"]);
}

#[test]
fn tensors_survive_their_pages_being_given_back() {
    let folder = tiny_folder();
    let checkpoint = Checkpoint::open(folder.path()).unwrap();
    let key = "unet_model.decoder.conv_in.weight";
    let shape = checkpoint.file().shape(key).unwrap().to_vec();
    let first = checkpoint.read(key, &shape).unwrap();
    assert_eq!(first, checkpoint.read(key, &shape).unwrap());
    let config = Config::from_json(TINY).unwrap();
    assert_eq!(first, RuleWeights::new(&config, tiny_overrides()).values(key, &shape));
    assert_eq!(mismatch(checkpoint.read("nothing", &[1]).unwrap_err()).missing, ["nothing"]);
    assert_eq!(mismatch(checkpoint.read(key, &[1]).unwrap_err()).misshaped.len(), 1);
}

#[test]
fn everything_that_is_wrong_is_found_at_once() {
    let folder = tiny_folder();
    assert!(examine(folder.path()).is_ok());
    let config = TINY
        .replace("\"Sat3DGen\"", "\"AutoencoderKL\"")
        .replace("\"oneplane\"", "\"twoplane\"")
        .replace("\"sr_factor\": 2", "\"sr_factor\": 3")
        .replace("\"mlp_hidden_dim\": 32", "\"mlp_hidden_dim\": 33")
        .replace("\"use_gated_mlp\": false", "\"use_gated_mlp\": true");
    std::fs::write(folder.path().join("config.json"), &config).unwrap();
    let weights = folder.path().join(WEIGHTS_FILE);
    let whole = std::fs::read(&weights).unwrap();
    std::fs::write(&weights, &whole[..whole.len() - 1]).unwrap();
    let found = examine(folder.path()).unwrap_err();
    let text = found.to_string();
    assert_eq!(found.problems.len(), 6, "{text}");
    for part in [
        "6 problems:",
        "1. ",
        "AutoencoderKL",
        "opt.representation_type",
        "opt.network.sr_factor",
        "opt.network.mlp_hidden_dim",
        "opt.backbone_config.use_gated_mlp",
        "6. ",
        "cut off",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
    // With nothing but another class, the tensors are still held against the config.
    let mut tensors = tiny_tensors();
    tensors.remove("mlp.net0.bias");
    let other = written(&tensors, &TINY.replace("\"Sat3DGen\"", "\"AutoencoderKL\""));
    let found = examine(other.path()).unwrap_err();
    assert_eq!(found.problems.len(), 2, "{found}");
    assert!(found.to_string().contains("1 missing: mlp.net0.bias"), "{found}");
    // One problem reads as that error does.
    let one = written(&tensors, TINY);
    let expected = Checkpoint::open(one.path()).unwrap_err().to_string();
    assert_eq!(examine(one.path()).unwrap_err().to_string(), expected);
    // No JSON, a value of a wrong type, nothing at all.
    for (text, part) in [("{", "config.json: EOF"), ("{\"_class_name\": \"Sat3DGen\"}", "`opt` is")]
    {
        std::fs::write(one.path().join("config.json"), text).unwrap();
        let found = examine(one.path()).unwrap_err();
        assert!(found.to_string().contains(part), "{found}");
    }
    assert!(examine(Path::new("/no/such/folder")).is_err());
}

#[test]
fn what_is_left_over_is_named_and_every_byte_is_reported() {
    let without = TINY.replace("\"sr_factor\": 2", "\"sr_factor\": 1");
    let folder = written(&tiny_tensors(), &without);
    let checkpoint = Checkpoint::open(folder.path()).unwrap();
    let hashed = std::sync::atomic::AtomicU64::new(0);
    let add = |bytes| _ = hashed.fetch_add(bytes, std::sync::atomic::Ordering::Relaxed);
    let inspection = inspect_with(&checkpoint, &add);
    // Eleven of super-resolution, the mask token, the triplane's axes.
    assert_eq!(inspection.left_over.len(), 13, "{:?}", inspection.left_over);
    assert!(inspection.absent.is_empty());
    let of_modules: u64 = inspection.modules.iter().map(|module| module.bytes).sum();
    assert_eq!(of_modules, 4 * inspection.parameters);
    assert_eq!(hashed.into_inner(), inspection.bytes + of_modules);
    assert_eq!(inspection, inspect(&checkpoint));
}
