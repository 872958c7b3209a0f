//! The config of the small network: the same file with another class name and fewer switches.

use super::reader::Reader;
use super::{
    BackboneConfig, Border, Config, DecoderConfig, PATCHES, UNetConfig, activation, padding,
};
use crate::error::ModelError;
use crate::field::Representation;
use crate::network::{UNET_STEM, UNET_TEXELS};

/// Length of the small model's style code: the sky's mean colour.
pub(crate) const STYLE: usize = 3;

/// Reads it.
pub(super) fn small(
    class_name: String,
    opt: &Reader<'_>,
    network: &Reader<'_>,
    triplane: &Reader<'_>,
) -> Result<Config, ModelError> {
    opt.only_text("backbone", "unet", "unet")?;
    opt.only_text("representation_type", "oneplane", "oneplane")?;
    let sizes = opt.required_object("backbone_config")?;
    sizes.only_text("model_type", "unet", "unet")?;
    let three = |key: &str| -> Result<[usize; 3], ModelError> {
        let values = sizes.counts(key)?.unwrap_or_default();
        <[usize; 3]>::try_from(values)
            .map_err(|_| sizes.invalid(key, "three whole numbers above 0"))
    };
    let unet = UNetConfig {
        widths: three("widths")?,
        blocks: three("blocks")?,
        attention: sizes.natural("attention")?.unwrap_or(0),
        heads: sizes.count("heads")?.unwrap_or(4),
        auxiliary: sizes.natural("auxiliary")?.unwrap_or(0),
    };
    let deep = unet.widths[2];
    if !deep.is_multiple_of(unet.heads) {
        return Err(sizes.invalid("heads", "has to divide the last of `widths`"));
    }
    let (pad, scale) = padding(opt, network)?;
    let plane_channels = triplane.required_count("dim")?;
    let head_hidden = network.count("mlp_hidden_dim")?.unwrap_or(32);
    if head_hidden % 2 != 0 {
        return Err(network.invalid("mlp_hidden_dim", "an even number"));
    }
    let sampling = network.object("point_sampling_kwargs")?;
    let samples = |key, default| match &sampling {
        Some(sampling) => sampling.count(key).map(|count| count.unwrap_or(default)),
        None => Ok(default),
    };
    // Each level but the last doubles: 16 tokens to 16 * 4 places of 2 texels each.
    let levels = (UNET_STEM * UNET_TEXELS).ilog2() as usize + 1;
    Ok(Config {
        class_name,
        backbone: BackboneConfig {
            name: "unet".into(),
            hidden: deep,
            layers: unet.attention,
            heads: unet.heads,
            intermediate: 2 * deep,
            patch: 256 / PATCHES,
            registers: 0,
            layer_norm_epsilon: 1e-5,
            rope_theta: 100.0,
        },
        pad,
        scale,
        representation: Representation::Oneplane,
        plane_channels,
        decoder: DecoderConfig {
            inputs: deep,
            channels: unet.widths[0],
            multipliers: vec![1; levels],
            outputs: 2 * plane_channels,
            attention: false,
        },
        sky: DecoderConfig {
            inputs: STYLE,
            channels: STYLE,
            multipliers: vec![1],
            outputs: 3,
            attention: false,
        },
        sky_mapping_layers: 0,
        style: STYLE,
        head_hidden,
        color_channels: 3,
        activation: activation(network)?,
        super_resolution: 1,
        super_resolution_channels: 1,
        super_resolution_border: Border::Zeros,
        coarse_samples: samples("num_points", 48)?,
        fine_samples: samples("num_importance", 48)?,
        render_size: opt.count("render_size")?.unwrap_or(256),
        unet: Some(unet),
    })
}
