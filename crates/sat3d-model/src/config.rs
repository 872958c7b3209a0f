//! `config.json`: every switch of the network, with the reference's defaults where it is silent.
//!
//! What has no proof of parity (MODEL_SPEC section 14) is refused with the key, its value, and what
//! is served. Sizes are checked here, so that later stages cannot meet an impossible network.

use crate::error::ModelError;
use crate::field::{DensityActivation, Representation};
use crate::render::padded_width;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

mod reader;
mod small;

use reader::Reader;
#[cfg(feature = "train")]
pub(crate) use small::STYLE as SMALL_STYLE;
use small::small;

/// Class names of a checkpoint: the released one, and the alias that older trainings wrote.
const CLASS_NAMES: [&str; 2] = ["Sat3DGen", "VAE_finetune"];
/// Class name of the small model, which the reference does not know.
const SMALL_CLASS: &str = "Sat3DMini";
/// The `config.json` of the release.
pub const RELEASED: &str = include_str!("config/released.json");
/// Length of the illumination histogram: 90 bins of 3 channels (section 9.3).
pub const HISTOGRAM: usize = 270;
/// Patches along each side of the image; fixed by the reference.
pub const PATCHES: usize = 16;
/// Groups of every GroupNorm.
pub const GROUPS: usize = 32;
/// Side of the constant map that the sky decoder starts from.
pub const SKY_SEED: usize = 8;

/// Sizes of the DINOv3 encoder (section 3).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BackboneConfig {
    /// Name in the config, as `dinov3-large-sat`.
    pub name: String,
    /// Channels of a token.
    pub hidden: usize,
    /// Transformer blocks.
    pub layers: usize,
    /// Attention heads.
    pub heads: usize,
    /// Hidden channels of each block's MLP.
    pub intermediate: usize,
    /// Pixels along a patch's side.
    pub patch: usize,
    /// Register tokens between class token and patches.
    pub registers: usize,
    /// Epsilon of each LayerNorm.
    pub layer_norm_epsilon: f64,
    /// Base of the rotary frequencies.
    pub rope_theta: f64,
}

impl BackboneConfig {
    /// Channels of one attention head.
    #[must_use]
    pub fn head(&self) -> usize {
        self.hidden / self.heads
    }
}

/// Sizes of a convolutional decoder (section 5).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DecoderConfig {
    /// Channels of the input map.
    pub inputs: usize,
    /// Channels at multiplier 1.
    pub channels: usize,
    /// Channel multipliers by level; the last one comes first in the network.
    pub multipliers: Vec<usize>,
    /// Channels of the output map.
    pub outputs: usize,
    /// Whether the middle has an attention block.
    pub attention: bool,
}

impl DecoderConfig {
    /// Channels of a level.
    #[must_use]
    pub fn width(&self, level: usize) -> usize {
        self.channels * self.multipliers[level]
    }

    /// Side of the output for a given side of the input: each level but the last doubles it.
    #[must_use]
    pub fn output_side(&self, side: usize) -> usize {
        side << (self.multipliers.len() - 1)
    }
}

/// Sizes of the small convolutional network that stands in for encoder and decoder
/// ([`crate::network`]).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct UNetConfig {
    /// Channels at 64, 32 and 16 places to a side.
    pub widths: [usize; 3],
    /// Residual blocks at each.
    pub blocks: [usize; 3],
    /// Blocks of attention at the lowest level.
    pub attention: usize,
    /// Heads of each.
    pub heads: usize,
    /// Channels beside the plane's that training supervises; a finished model has none.
    pub auxiliary: usize,
}

/// How a convolution of the super-resolution module continues its input over the border.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Border {
    /// Zeros.
    Zeros,
    /// Mirrored, the border pixel not repeated.
    Reflect,
    /// The other side's pixels.
    Circular,
}

/// The whole network, resolved: nothing is left to a default.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Config {
    /// Class named in the file.
    pub class_name: String,
    /// The encoder.
    pub backbone: BackboneConfig,
    /// The small network in place of encoder and decoder; then `backbone` and `decoder` hold its outer
    /// sizes, and there is no network for the sky.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unet: Option<UNetConfig>,
    /// Fraction of the image added as empty tokens on each side (0.125 in the release; 0 for none).
    pub pad: f64,
    /// `position_scale_factor`: the image covers x and y in [-scale, scale] of the cube.
    pub scale: f64,
    /// How points read the decoder's map.
    pub representation: Representation,
    /// Channels of a plane.
    pub plane_channels: usize,
    /// Tokens to feature map.
    pub decoder: DecoderConfig,
    /// Style code to sky map.
    pub sky: DecoderConfig,
    /// Layers that map the histogram to the style code.
    pub sky_mapping_layers: usize,
    /// Length of the style code.
    pub style: usize,
    /// Hidden channels of the point head.
    pub head_hidden: usize,
    /// Colour channels of the field; the first three are RGB.
    pub color_channels: usize,
    /// Raw to volume density.
    pub activation: DensityActivation,
    /// 2 where rendered views pass through the super-resolution module, else 1.
    pub super_resolution: usize,
    /// Channels of the super-resolution module.
    pub super_resolution_channels: usize,
    /// Border of its convolutions.
    pub super_resolution_border: Border,
    /// Coarse samples along a ray.
    pub coarse_samples: usize,
    /// Importance samples along a ray.
    pub fine_samples: usize,
    /// Side of the rendered satellite view that training worked with.
    pub render_size: usize,
}

impl Config {
    /// The released network.
    ///
    /// # Panics
    /// Never: the text is part of the program, and a test reads it.
    #[must_use]
    pub fn released() -> Self {
        Self::from_json(RELEASED).expect("the released config is served")
    }

    /// Reads `config.json` of a checkpoint folder (the folder itself; see
    /// [`crate::weights::locate`] for training checkpoints).
    ///
    /// # Errors
    /// [`ModelError::Io`], and those of [`Config::from_json`].
    pub fn from_folder(folder: &Path) -> Result<Self, ModelError> {
        let path = folder.join("config.json");
        let text = std::fs::read_to_string(&path).map_err(ModelError::io(&path))?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Reads the text of a `config.json`.
    ///
    /// # Errors
    /// [`ModelError::ConfigSyntax`], [`ModelError::ClassName`], [`ModelError::Unsupported`],
    /// [`ModelError::InvalidConfig`].
    pub fn from_json(text: &str) -> Result<Self, ModelError> {
        Self::parse(text, "config")
    }

    fn parse(text: &str, origin: &str) -> Result<Self, ModelError> {
        let root: Value = serde_json::from_str(text).map_err(|error| ModelError::ConfigSyntax {
            origin: origin.into(),
            message: error.to_string(),
        })?;
        let class_name = match root.get("_class_name") {
            Some(Value::String(name))
                if CLASS_NAMES.contains(&name.as_str()) || name == SMALL_CLASS =>
            {
                name.clone()
            }
            other => {
                return Err(ModelError::ClassName {
                    origin: origin.into(),
                    found: other.map_or_else(|| "missing".into(), Value::to_string),
                });
            }
        };
        let opt = Reader::root(&root, origin).required_object("opt")?;
        let network = opt.required_object("network")?;
        let triplane = network.required_object("triplane")?;

        if class_name == SMALL_CLASS {
            return small(class_name, &opt, &network, &triplane);
        }
        let backbone = backbone(&opt)?;
        only(&network, "no_hidden_states", false, true)?;
        only(&network, "no_cls_token", false, true)?;
        network.only_text("sat_mapping_mode", "v2", "v2")?;
        let (pad, scale) = padding(&opt, &network)?;
        let representation = match opt.text("representation_type")?.unwrap_or("triplane") {
            "oneplane" => Representation::Oneplane,
            "oneplane_multi" => Representation::OneplaneMulti,
            "triplane" => Representation::Triplane,
            _ => return Err(opt.unsupported("representation_type", REPRESENTATIONS)),
        };
        let super_resolution = network.count("sr_factor")?.unwrap_or(1);
        if !matches!(super_resolution, 1 | 2) {
            return Err(network.unsupported("sr_factor", "1, 2"));
        }
        let super_resolution_border = match opt.text("sr_padding_mode")?.unwrap_or("zeros") {
            "zeros" => Border::Zeros,
            "reflect" => Border::Reflect,
            "circular" => Border::Circular,
            _ => return Err(opt.unsupported("sr_padding_mode", BORDERS)),
        };
        let plane_channels = triplane.required_count("dim")?;
        let planes = if representation == Representation::Triplane { 3 } else { 2 };
        let color_channels = network.count("color_channels")?.unwrap_or(32);
        if color_channels < 3 {
            return Err(network.invalid("color_channels", "at least 3 for red, green and blue"));
        }
        let style = network.count("w_dim")?.unwrap_or(512);
        let decoder = DecoderConfig {
            inputs: backbone.hidden,
            channels: network.count("decoder_ch")?.unwrap_or(128),
            multipliers: triplane.counts("ch_mult")?.unwrap_or_else(|| vec![1, 2, 4, 4, 4]),
            outputs: planes * plane_channels,
            attention: network.flag("with_attn")?.unwrap_or(true),
        };
        decoder_fits(&decoder, &triplane, "ch_mult")?;
        let sky = DecoderConfig {
            inputs: style,
            channels: network.count("sky_decoder_ch")?.unwrap_or(32),
            multipliers: network
                .counts("sky_decoder_ch_mult")?
                .unwrap_or_else(|| vec![1, 2, 2, 4, 4, 4, 4]),
            outputs: color_channels,
            attention: false,
        };
        decoder_fits(&sky, &network, "sky_decoder_ch_mult")?;
        let head_hidden = network.count("mlp_hidden_dim")?.unwrap_or(64);
        if head_hidden % 2 != 0 {
            return Err(network.invalid("mlp_hidden_dim", "an even number"));
        }
        let sampling = network.object("point_sampling_kwargs")?;
        let samples = |key, default| match &sampling {
            Some(sampling) => sampling.count(key).map(|count| count.unwrap_or(default)),
            None => Ok(default),
        };
        Ok(Self {
            class_name,
            backbone,
            unet: None,
            pad,
            scale,
            representation,
            plane_channels,
            decoder,
            sky,
            sky_mapping_layers: network.count("sky_mapping_layers")?.unwrap_or(8),
            style,
            head_hidden,
            color_channels,
            activation: activation(&network)?,
            super_resolution,
            super_resolution_channels: network.count("sr_channels")?.unwrap_or(128),
            super_resolution_border,
            coarse_samples: samples("num_points", 48)?,
            fine_samples: samples("num_importance", 48)?,
            render_size: opt.count("render_size")?.unwrap_or(256),
        })
    }

    /// Side of the image that the network reads, in pixels (256 for patches of 16).
    #[must_use]
    pub fn image_side(&self) -> usize {
        PATCHES * self.backbone.patch
    }

    /// Empty tokens added on each side of the patch grid.
    #[must_use]
    pub fn pad_tokens(&self) -> usize {
        // Checked to be whole when the config was read.
        (self.pad * PATCHES as f64) as usize
    }

    /// Side of the decoder's map (320 in the release).
    #[must_use]
    pub fn map_side(&self) -> usize {
        self.decoder.output_side(PATCHES + 2 * self.pad_tokens())
    }

    /// Height of the sky map and width of its filled part (512 in the release).
    #[must_use]
    pub fn sky_side(&self) -> usize {
        self.sky.output_side(SKY_SEED)
    }

    /// Width of the sky map with the empty columns below the horizon (921 in the release).
    #[must_use]
    pub fn sky_width(&self) -> usize {
        padded_width(self.sky_side())
    }

    /// Length of a point's feature vector.
    #[must_use]
    pub fn point_features(&self) -> usize {
        match self.representation {
            Representation::Oneplane => 2 * self.plane_channels,
            Representation::OneplaneMulti | Representation::Triplane => self.plane_channels,
        }
    }
}

const REPRESENTATIONS: &str = "\"oneplane\", \"oneplane_multi\", \"triplane\"";
const BORDERS: &str = "\"zeros\", \"reflect\", \"circular\"";

/// Refuses a boolean switch that is (or by default would be) anything but `served`.
fn only(reader: &Reader<'_>, key: &str, default: bool, served: bool) -> Result<(), ModelError> {
    if reader.flag(key)?.unwrap_or(default) == served {
        return Ok(());
    }
    let default = format!("{served} (absent means {default})");
    Err(reader.unsupported(key, &default))
}

fn backbone(opt: &Reader<'_>) -> Result<BackboneConfig, ModelError> {
    const SERVED: &str = "\"dinov3-large-sat\", \"dinov3-large-lvd\", or any name with a \
                          `backbone_config` of `model_type` \"dinov3_vit\"";
    let name = opt.text("backbone")?.unwrap_or("dinov2-base");
    let sizes = opt.object("backbone_config")?;
    let known = matches!(name, "dinov3-large-sat" | "dinov3-large-lvd");
    if name.starts_with("dinov2") || !(known || sizes.is_some()) {
        return Err(opt.unsupported("backbone", SERVED));
    }
    let mut config = BackboneConfig {
        name: name.into(),
        hidden: 1024,
        layers: 24,
        heads: 16,
        intermediate: 4096,
        patch: 16,
        registers: 4,
        layer_norm_epsilon: 1e-5,
        rope_theta: 100.0,
    };
    let Some(sizes) = sizes else { return Ok(config) };
    sizes.only_text("model_type", "dinov3_vit", "dinov3_vit")?;
    sizes.only_text("hidden_act", "gelu", "gelu")?;
    only(&sizes, "use_gated_mlp", false, false)?;
    only(&sizes, "key_bias", false, false)?;
    for bias in ["query_bias", "value_bias", "proj_bias", "mlp_bias"] {
        only(&sizes, bias, true, true)?;
    }
    if sizes.count("num_channels")?.is_some_and(|channels| channels != 3) {
        return Err(sizes.unsupported("num_channels", "3"));
    }
    for (key, value) in [
        ("hidden_size", &mut config.hidden),
        ("num_hidden_layers", &mut config.layers),
        ("num_attention_heads", &mut config.heads),
        ("intermediate_size", &mut config.intermediate),
        ("patch_size", &mut config.patch),
    ] {
        *value = sizes.count(key)?.unwrap_or(*value);
    }
    config.registers = sizes.natural("num_register_tokens")?.unwrap_or(config.registers);
    for (key, value) in
        [("layer_norm_eps", &mut config.layer_norm_epsilon), ("rope_theta", &mut config.rope_theta)]
    {
        *value = sizes.number(key)?.unwrap_or(*value);
        if *value <= 0.0 {
            return Err(sizes.invalid(key, "more than 0"));
        }
    }
    if !config.hidden.is_multiple_of(config.heads) || !config.head().is_multiple_of(4) {
        return Err(sizes.invalid("num_attention_heads", HEADS));
    }
    Ok(config)
}

const HEADS: &str = "has to divide hidden_size into heads of a multiple of 4 channels";

/// Padding and the part of the cube that the image covers (section 1).
fn padding(opt: &Reader<'_>, network: &Reader<'_>) -> Result<(f64, f64), ModelError> {
    let factor = network.number("position_scale_factor")?;
    let Some(pad) = opt.number("pad")? else {
        let scale = factor.unwrap_or(1.0);
        if scale <= 0.0 || scale > 1.0 {
            return Err(network.invalid("position_scale_factor", "above 0, at most 1"));
        }
        return Ok((0.0, scale));
    };
    if factor.is_some_and(|factor| factor != 1.0) {
        let why = "has to be 1 where `opt.pad` is given: the padding decides the scale";
        return Err(network.invalid("position_scale_factor", why));
    }
    let tokens = pad * PATCHES as f64;
    if !(0.0..=PATCHES as f64).contains(&tokens) || tokens.fract() != 0.0 {
        return Err(opt.invalid("pad", "a multiple of 1/16 (whole tokens) from 0 to 1"));
    }
    Ok((pad, 1.0 / (1.0 + 2.0 * pad)))
}

fn activation(network: &Reader<'_>) -> Result<DensityActivation, ModelError> {
    let Some(marching) = network.object("ray_marching_kwargs")? else {
        // The reference scales colours where nothing says otherwise.
        return Err(network.unsupported("ray_marching_kwargs", "an object, `scale_color` false"));
    };
    only(&marching, "scale_color", true, false)?;
    only(&marching, "use_mid_point", true, true)?;
    only(&marching, "use_dist", true, true)?;
    for key in
        ["use_white_background", "normalize_color", "normalize_radial_dist", "clip_radial_dist"]
    {
        only(&marching, key, false, false)?;
    }
    marching.only_text("color_clamp_mode", "none", "none")?;
    if marching.number("density_noise_std")?.is_some_and(|noise| noise != 0.0) {
        return Err(marching.unsupported("density_noise_std", "0"));
    }
    if marching.number("delta_modulate_scalar")?.is_some_and(|scalar| scalar != 1.0) {
        return Err(marching.unsupported("delta_modulate_scalar", "1"));
    }
    match marching.text("density_clamp_mode")?.unwrap_or("relu") {
        "mipnerf" => Ok(DensityActivation::Mipnerf),
        "relu" => Ok(DensityActivation::Relu),
        _ => Err(marching.unsupported("density_clamp_mode", "\"mipnerf\", \"relu\"")),
    }
}

/// GroupNorm needs whole groups at every level, and maps must stay of a size that fits in memory.
fn decoder_fits(decoder: &DecoderConfig, reader: &Reader<'_>, key: &str) -> Result<(), ModelError> {
    let levels = decoder.multipliers.len();
    if !(1..=8).contains(&levels) {
        return Err(reader.invalid(key, "1 to 8 levels"));
    }
    if (0..levels).any(|level| !decoder.width(level).is_multiple_of(GROUPS)) {
        return Err(reader.invalid(
            key,
            &format!(
                "times {} channels has to be a multiple of {GROUPS} at every level",
                decoder.channels
            ),
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
