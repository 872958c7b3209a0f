//! The tensors that a config asks for: keys, shapes, and which of them may be absent.

use crate::config::{Config, DecoderConfig, HISTOGRAM, PATCHES, UNetConfig};
use crate::field::Representation;
use crate::network::{UNET_STEM, UNET_TEXELS};

/// Whether a checkpoint must hold a tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// It must.
    Required,
    /// A parameter that no output depends on: it may be absent, or left over in any shape.
    Optional,
    /// A constant, not a parameter; may be absent or left over too.
    Buffer,
}

/// One tensor of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorSpec {
    /// Key in the safetensors file.
    pub key: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Whether it must be there.
    pub need: Need,
}

impl TensorSpec {
    /// Number of values.
    #[must_use]
    pub fn values(&self) -> usize {
        self.shape.iter().product()
    }
}

/// All tensors of a config's network (MODEL_SPEC sections 3-9), module by module.
///
/// Both buffers of the point representer are listed, whatever the representation: either may be
/// left over. The one of another representation is not part of a whole checkpoint (see
/// [`super::rule`], which leaves it out).
#[must_use]
pub fn expected(config: &Config) -> Vec<TensorSpec> {
    let mut list = List { specs: Vec::new(), need: Need::Required };
    if let Some(unet) = &config.unet {
        list.unet(config, unet);
        list.head(config);
        return list.specs;
    }
    list.encoder(config);
    list.decoder("unet_model.decoder", &config.decoder);
    list.head(config);
    list.sky_mapping(config);
    list.decoder("sky_decoder", &config.sky);
    list.need = if config.super_resolution == 2 { Need::Required } else { Need::Optional };
    list.super_resolution(config);
    list.need = Need::Buffer;
    list.push("point_representer.oneplane_axes".into(), &[1, 3, 3]);
    list.push("point_representer.triplane_axes".into(), &[3, 3, 3]);
    list.specs
}

/// The buffer that a config's own checkpoint carries.
pub(super) fn own_buffer(config: &Config) -> &'static str {
    match config.representation {
        Representation::Triplane => "point_representer.triplane_axes",
        Representation::Oneplane | Representation::OneplaneMulti => {
            "point_representer.oneplane_axes"
        }
    }
}

struct List {
    specs: Vec<TensorSpec>,
    need: Need,
}

impl List {
    fn push(&mut self, key: String, shape: &[usize]) {
        self.specs.push(TensorSpec { key, shape: shape.to_vec(), need: self.need });
    }

    /// Scale and shift of a norm.
    fn norm(&mut self, path: &str, channels: usize) {
        self.push(format!("{path}.weight"), &[channels]);
        self.push(format!("{path}.bias"), &[channels]);
    }

    fn linear(&mut self, path: &str, inputs: usize, outputs: usize) {
        self.push(format!("{path}.weight"), &[outputs, inputs]);
        self.push(format!("{path}.bias"), &[outputs]);
    }

    fn conv(&mut self, path: &str, inputs: usize, outputs: usize, side: usize) {
        self.push(format!("{path}.weight"), &[outputs, inputs, side, side]);
        self.push(format!("{path}.bias"), &[outputs]);
    }

    fn unet(&mut self, config: &Config, unet: &UNetConfig) {
        let [wide, middle, deep] = unet.widths;
        let blocks = |list: &mut Self, name: &str, width: usize, count: usize| {
            for block in 0..count {
                for conv in ["conv1", "conv2"] {
                    list.conv(&format!("unet.{name}.{block}.{conv}"), width, width, 3);
                }
            }
        };
        self.conv("unet.stem", 3, wide, UNET_STEM);
        blocks(self, "level0", wide, unet.blocks[0]);
        self.conv("unet.down1", wide, middle, 2);
        blocks(self, "level1", middle, unet.blocks[1]);
        self.conv("unet.down2", middle, deep, 2);
        blocks(self, "level2", deep, unet.blocks[2]);
        self.push("unet.position".into(), &[PATCHES * PATCHES, deep]);
        for block in 0..unet.attention {
            let path = format!("unet.attention.{block}");
            self.norm(&format!("{path}.norm1"), deep);
            self.linear(&format!("{path}.qkv"), deep, 3 * deep);
            self.linear(&format!("{path}.proj"), deep, deep);
            self.norm(&format!("{path}.norm2"), deep);
            self.linear(&format!("{path}.up"), deep, 2 * deep);
            self.linear(&format!("{path}.down"), 2 * deep, deep);
        }
        self.conv("unet.up1", deep, middle, 1);
        blocks(self, "merge1", middle, unet.blocks[1]);
        self.conv("unet.up0", middle, wide, 1);
        blocks(self, "merge0", wide, unet.blocks[0]);
        let texels = UNET_TEXELS * UNET_TEXELS;
        self.conv("unet.plane", wide, texels * (config.plane_channels + unet.auxiliary), 1);
        self.push("unet.line".into(), &[config.plane_channels, config.map_side()]);
    }

    fn encoder(&mut self, config: &Config) {
        let backbone = &config.backbone;
        let (hidden, patch) = (backbone.hidden, backbone.patch);
        let root = "unet_model.dino_model";
        self.push(format!("{root}.embeddings.cls_token"), &[1, 1, hidden]);
        self.need = Need::Optional;
        self.push(format!("{root}.embeddings.mask_token"), &[1, 1, hidden]);
        self.need = Need::Required;
        self.push(format!("{root}.embeddings.register_tokens"), &[1, backbone.registers, hidden]);
        self.conv(&format!("{root}.embeddings.patch_embeddings"), 3, hidden, patch);
        for layer in 0..backbone.layers {
            let path = format!("{root}.layer.{layer}");
            self.norm(&format!("{path}.norm1"), hidden);
            self.push(format!("{path}.attention.k_proj.weight"), &[hidden, hidden]);
            for projection in ["v_proj", "q_proj", "o_proj"] {
                self.linear(&format!("{path}.attention.{projection}"), hidden, hidden);
            }
            self.push(format!("{path}.layer_scale1.lambda1"), &[hidden]);
            self.norm(&format!("{path}.norm2"), hidden);
            self.linear(&format!("{path}.mlp.up_proj"), hidden, backbone.intermediate);
            self.linear(&format!("{path}.mlp.down_proj"), backbone.intermediate, hidden);
            self.push(format!("{path}.layer_scale2.lambda1"), &[hidden]);
        }
        self.norm(&format!("{root}.norm"), hidden);
    }

    fn decoder(&mut self, root: &str, config: &DecoderConfig) {
        let top = config.multipliers.len() - 1;
        let mut width = config.width(top);
        self.conv(&format!("{root}.conv_in"), config.inputs, width, 3);
        self.block(&format!("{root}.mid.block_1"), width, width);
        if config.attention {
            let path = format!("{root}.mid.attn_1");
            self.norm(&format!("{path}.norm"), width);
            for projection in ["q", "k", "v", "proj_out"] {
                self.conv(&format!("{path}.{projection}"), width, width, 1);
            }
        }
        self.block(&format!("{root}.mid.block_2"), width, width);
        for level in (0..=top).rev() {
            for block in 0..3 {
                let outputs = config.width(level);
                self.block(&format!("{root}.up.{level}.block.{block}"), width, outputs);
                width = outputs;
            }
            if level > 0 {
                self.conv(&format!("{root}.up.{level}.upsample.conv"), width, width, 3);
            }
        }
        self.norm(&format!("{root}.norm_out"), width);
        self.conv(&format!("{root}.conv_out"), width, config.outputs, 3);
    }

    fn block(&mut self, path: &str, inputs: usize, outputs: usize) {
        self.norm(&format!("{path}.norm1"), inputs);
        self.conv(&format!("{path}.conv1"), inputs, outputs, 3);
        self.norm(&format!("{path}.norm2"), outputs);
        self.conv(&format!("{path}.conv2"), outputs, outputs, 3);
        if inputs != outputs {
            self.conv(&format!("{path}.nin_shortcut"), inputs, outputs, 1);
        }
    }

    fn head(&mut self, config: &Config) {
        let hidden = config.head_hidden;
        self.linear("mlp.net0", config.point_features(), hidden);
        self.linear("mlp.net1_feature", hidden, hidden / 2);
        self.linear("mlp.net1_density", hidden, 1);
        self.linear("mlp.style_squ", config.style, hidden / 2);
        self.linear("mlp.grd_color_convert", hidden, config.color_channels);
    }

    fn sky_mapping(&mut self, config: &Config) {
        for layer in 0..config.sky_mapping_layers {
            let last = layer + 1 == config.sky_mapping_layers;
            let outputs = if last { config.style } else { HISTOGRAM };
            // Odd places of the list are activations.
            self.linear(&format!("sky_mapping.mapping.{}", 2 * layer), HISTOGRAM, outputs);
        }
    }

    fn super_resolution(&mut self, config: &Config) {
        let (inputs, width) = (config.color_channels, config.super_resolution_channels);
        self.conv("sr_module.block0.conv0.conv", inputs, width, 3);
        self.conv("sr_module.block0.conv1.conv", width, width, 3);
        self.conv("sr_module.block0.skip_conv", inputs, width, 1);
        self.conv("sr_module.block1.conv0.conv", width, width, 3);
        self.conv("sr_module.block1.conv1.conv", width, width, 3);
        self.push("sr_module.block1.toRGB.weight".into(), &[3, width, 1, 1]);
    }
}
