#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::*;
use serde_json::json;

/// The released config with one value set (or, by null, removed).
fn with(path: &[&str], value: Value) -> Result<Config, ModelError> {
    let mut root: Value = serde_json::from_str(RELEASED).unwrap();
    let (last, parents) = path.split_last().unwrap();
    let mut place = &mut root;
    for key in parents {
        if place.get(*key).is_none() {
            place[*key] = json!({});
        }
        place = &mut place[*key];
    }
    if value.is_null() {
        place.as_object_mut().unwrap().remove(*last);
    } else {
        place[*last] = value;
    }
    Config::from_json(&root.to_string())
}

#[test]
fn the_release_is_read() {
    let config = Config::released();
    assert_eq!((config.backbone.hidden, config.backbone.layers), (1024, 24));
    assert_eq!((config.backbone.head(), config.backbone.registers), (64, 4));
    assert_eq!((config.image_side(), config.pad_tokens(), config.map_side()), (256, 2, 320));
    assert_eq!((config.sky_side(), config.sky_width()), (512, 921));
    assert_eq!((config.decoder.outputs, config.point_features()), (64, 64));
    assert_eq!(config.representation, Representation::Oneplane);
    assert_eq!(config.activation, DensityActivation::Mipnerf);
    assert_eq!(config.super_resolution_border, Border::Reflect);
    assert!((config.scale - 0.8).abs() < 1e-15);
    assert_eq!((config.coarse_samples, config.fine_samples), (48, 48));
}

#[test]
fn silence_means_the_references_defaults() {
    let read = |path: &[&str]| with(path, Value::Null).unwrap();
    assert_eq!(read(&["opt", "representation_type"]).representation, Representation::Triplane);
    assert_eq!(read(&["opt", "representation_type"]).decoder.outputs, 96);
    assert_eq!(read(&["opt", "sr_padding_mode"]).super_resolution_border, Border::Zeros);
    assert_eq!(read(&["opt", "network", "sr_factor"]).super_resolution, 1);
    assert_eq!(read(&["opt", "network", "color_channels"]).color_channels, 32);
    let multipliers = read(&["opt", "network", "triplane", "ch_mult"]).decoder.multipliers;
    assert_eq!(multipliers, [1, 2, 4, 4, 4]);
    let unpadded = read(&["opt", "pad"]);
    assert_eq!((unpadded.pad_tokens(), unpadded.map_side()), (0, 256));
    assert_eq!(unpadded.scale.to_bits(), 1.0_f64.to_bits());
    let marching = &["opt", "network", "ray_marching_kwargs", "density_clamp_mode"];
    assert_eq!(with(marching, Value::Null).unwrap().activation, DensityActivation::Relu);
}

#[test]
fn what_has_no_proof_is_refused_by_key_and_value() {
    let network = |key| vec!["opt", "network", key];
    let marching = |key| vec!["opt", "network", "ray_marching_kwargs", key];
    let backbone = |key| vec!["opt", "backbone_config", key];
    let cases = [
        (vec!["opt", "backbone"], json!("dinov2-base")),
        (vec!["opt", "backbone"], json!("mystery")),
        (vec!["opt", "backbone"], Value::Null),
        (vec!["opt", "representation_type"], json!("biplane")),
        (vec!["opt", "sr_padding_mode"], json!("replicate")),
        (network("no_hidden_states"), json!(false)),
        (network("no_hidden_states"), Value::Null),
        (network("no_cls_token"), json!(false)),
        (network("sat_mapping_mode"), json!("v1")),
        (network("sr_factor"), json!(4)),
        (network("ray_marching_kwargs"), Value::Null),
        (marching("density_clamp_mode"), json!("softplus")),
        (marching("scale_color"), json!(true)),
        (marching("scale_color"), Value::Null),
        (marching("use_mid_point"), json!(false)),
        (marching("use_dist"), json!(false)),
        (marching("use_white_background"), json!(true)),
        (marching("normalize_color"), json!(true)),
        (marching("color_clamp_mode"), json!("widen_sigmoid")),
        (marching("density_noise_std"), json!(0.1)),
        (marching("delta_modulate_scalar"), json!(2.0)),
        (backbone("model_type"), json!("dinov2")),
        (backbone("hidden_act"), json!("silu")),
        (backbone("use_gated_mlp"), json!(true)),
        (backbone("key_bias"), json!(true)),
        (backbone("mlp_bias"), json!(false)),
        (backbone("num_channels"), json!(4)),
    ];
    for (path, value) in cases {
        let shown = if value.is_null() { "(absent)".into() } else { value.to_string() };
        let error = with(&path, value).unwrap_err();
        let text = error.to_string();
        assert!(matches!(error, ModelError::Unsupported { .. }), "{path:?}: {text}");
        assert!(text.contains(&format!("`{}`", path.join("."))), "{text}");
        assert!(text.contains(&shown) && text.contains("served: "), "{text}");
    }
}

#[test]
fn impossible_networks_are_refused() {
    let cases = [
        (vec!["opt", "pad"], json!(0.1)),
        (vec!["opt", "pad"], json!(-0.125)),
        (vec!["opt", "pad"], json!(3)),
        (vec!["opt", "network", "position_scale_factor"], json!(0.5)),
        (vec!["opt", "network", "color_channels"], json!(2)),
        (vec!["opt", "network", "decoder_ch"], json!(100)),
        (vec!["opt", "network", "triplane", "ch_mult"], json!([])),
        (vec!["opt", "network", "triplane", "ch_mult"], json!([1, 1, 1, 1, 1, 1, 1, 1, 1])),
        (vec!["opt", "network", "mlp_hidden_dim"], json!(33)),
        (vec!["opt", "backbone_config", "num_attention_heads"], json!(3)),
        (vec!["opt", "backbone_config", "layer_norm_eps"], json!(0.0)),
    ];
    for (path, value) in cases {
        let error = with(&path, value).unwrap_err();
        assert!(matches!(error, ModelError::InvalidConfig { .. }), "{path:?}: {error}");
    }
}

#[test]
fn wrong_types_and_missing_keys_are_named() {
    let cases = [
        (vec!["opt"], Value::Null, "`opt` is missing"),
        (vec!["opt", "network"], Value::Null, "`opt.network` is missing"),
        (vec!["opt", "network", "triplane"], json!(3), "`opt.network.triplane` = 3: expected"),
        (vec!["opt", "network", "triplane", "dim"], Value::Null, "triplane.dim` is missing"),
        (vec!["opt", "network", "triplane", "dim"], json!(-1), "expected a whole number"),
        (vec!["opt", "network", "triplane", "dim"], json!(0), "a whole number above 0"),
        (vec!["opt", "network", "triplane", "dim"], json!(1e12), "expected a whole number"),
        (vec!["opt", "network", "triplane", "ch_mult"], json!([1, "2"]), "expected a list"),
        (vec!["opt", "network", "no_cls_token"], json!("yes"), "expected true or false"),
        (vec!["opt", "pad"], json!("0.125"), "expected a number"),
        (vec!["opt", "backbone"], json!(7), "expected a string"),
    ];
    for (path, value, wanted) in cases {
        let error = with(&path, value).unwrap_err();
        assert!(matches!(error, ModelError::ConfigSyntax { .. }), "{path:?}: {error}");
        assert!(error.to_string().contains(wanted), "{error}");
    }
    assert!(matches!(Config::from_json("{"), Err(ModelError::ConfigSyntax { .. })));
}

#[test]
fn other_programs_checkpoints_are_refused() {
    for (value, shown) in
        [(json!("AutoencoderKL"), "\"AutoencoderKL\""), (json!(3), "3"), (Value::Null, "missing")]
    {
        let error = with(&["_class_name"], value).unwrap_err();
        assert!(matches!(error, ModelError::ClassName { .. }), "{error}");
        assert!(error.to_string().contains(shown), "{error}");
    }
    assert_eq!(with(&["_class_name"], json!("VAE_finetune")).unwrap().class_name, "VAE_finetune");
    assert!(matches!(Config::from_json("[]"), Err(ModelError::ClassName { .. })));
}

#[test]
fn any_size_of_dinov3_is_taken_from_its_own_config() {
    let mut root: Value = serde_json::from_str(RELEASED).unwrap();
    root["opt"]["backbone"] = json!("dinov3-small");
    root["opt"]["backbone_config"] = json!({
        "model_type": "dinov3_vit", "hidden_size": 384, "num_hidden_layers": 12,
        "num_attention_heads": 6, "intermediate_size": 1536, "num_register_tokens": 0,
    });
    let config = Config::from_json(&root.to_string()).unwrap();
    assert_eq!((config.backbone.hidden, config.backbone.registers), (384, 0));
    assert_eq!(config.decoder.inputs, 384);
}
