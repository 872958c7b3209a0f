use super::*;
use crate::train::losses::testing::{
    TORCH, check_gradients_at, device, scalar, stored, uniform, values, wide,
};
use burn::tensor::FloatDType;
use safetensors::SafeTensors;
use safetensors::tensor::TensorView;
use std::path::PathBuf;

/// Writes the fixture's narrow weights as a user's file would be, some left out or in another shape.
fn file(folder: &Path, name: &str, keep: impl Fn(&str) -> bool) -> PathBuf {
    let all = SafeTensors::deserialize(TORCH).expect("a whole file");
    let weights: Vec<(String, TensorView<'_>)> = all
        .tensors()
        .into_iter()
        .filter_map(|(key, view)| {
            let key = key.strip_prefix("lpips.weights.")?.to_owned();
            keep(&key).then_some((key, view))
        })
        .collect();
    let path = folder.join(name);
    safetensors::serialize_to_file(weights, None, &path).expect("a writable folder");
    path
}

/// The fixture's weights, as read from two files.
pub(in crate::train::losses) fn narrow_weights() -> Lpips {
    let folder = tempfile::tempdir().expect("a folder");
    let vgg = file(folder.path(), "vgg.safetensors", |key| key.starts_with("features"));
    let lin = file(folder.path(), "lin.safetensors", |key| key.starts_with("lin"));
    Lpips::read(&[&vgg, &lin], &device()).expect("weights")
}

#[test]
fn the_package_gives_the_same_distances_and_gradients() {
    let lpips = narrow_weights();
    let first = stored::<4>(TORCH, "lpips.first").require_grad();
    let ours = lpips.distance(first.clone(), stored(TORCH, "lpips.second"));
    let gradients = ours.clone().mean().backward();
    for (ours, theirs) in values(ours).iter().zip(values(stored::<1>(TORCH, "lpips.distance"))) {
        assert!((ours / theirs - 1.0).abs() < 2e-6, "{ours} {theirs}");
    }
    let ours = values(first.grad(&gradients).expect("a gradient"));
    let theirs = values(stored::<4>(TORCH, "lpips.gradient"));
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let error = norm(&mut ours.iter().zip(&theirs).map(|(a, b)| a - b));
    let size = norm(&mut theirs.iter().copied());
    assert!(error < 1e-5 * size, "{error} {size}");
}

#[test]
fn gradients_agree_with_differences() {
    let lpips = narrow_weights().cast(FloatDType::F64);
    let shapes = [[1, 3, 16, 16]; 2];
    let inputs = [1, 2].map(|seed| uniform(seed, 3 * 256, -1.0, 1.0));
    check_gradients_at("lpips", &shapes, &inputs, 1e-5, |input| {
        lpips.distance(input[0].clone(), input[1].clone()).mean()
    });
}

#[test]
fn equal_pictures_are_at_distance_nought() {
    let picture = || wide::<4>(uniform(3, 3 * 256, -1.0, 1.0), [1, 3, 16, 16]);
    let lpips = narrow_weights().cast(FloatDType::F64);
    assert_eq!(scalar(lpips.distance(picture(), picture())), 0.0);
}

#[test]
fn every_missing_key_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = file(folder.path(), "vgg.safetensors", |key| {
        key.starts_with("features") && key != "features.10.bias"
    });
    let error = Lpips::read(&[&path], &device()).expect_err("keys are missing").to_string();
    for key in ["6 missing", "features.10.bias", "lin0.model.1.weight", "lin4.model.1.weight"] {
        assert!(error.contains(key), "{error}");
    }
    assert!(Lpips::read(&[], &device()).is_err());
    assert!(Lpips::read(&[&folder.path().join("none.safetensors")], &device()).is_err());
}

#[test]
fn a_layer_that_does_not_fit_the_one_before_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = file(folder.path(), "weights.safetensors", |key| key != "features.7.weight");
    let other = folder.path().join("other.safetensors");
    let bytes = vec![0_u8; 4 * 6 * 5 * 9];
    let view = TensorView::new(safetensors::Dtype::F32, vec![6, 5, 3, 3], &bytes).expect("a view");
    safetensors::serialize_to_file([("features.7.weight", view)], None, &other).expect("a file");
    let error = Lpips::read(&[&path, &other], &device()).expect_err("5 is not 6").to_string();
    assert!(error.contains("features.7.weight") && error.contains("other"), "{error}");
}

#[test]
fn places_without_any_feature_have_finite_gradients() {
    let mut lpips = narrow_weights();
    for group in &mut lpips.groups {
        for (_, bias) in &mut group.convolutions {
            *bias = bias.clone() - 1e3;
        }
    }
    let first = stored::<4>(TORCH, "lpips.first").require_grad();
    let distance = lpips.distance(first.clone(), stored(TORCH, "lpips.second")).mean();
    let slopes = values(first.grad(&distance.backward()).expect("a gradient"));
    assert_eq!(scalar(distance), 0.0);
    assert!(slopes.iter().all(|v| *v == 0.0));
}
