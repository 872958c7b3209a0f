//! Layers with their weights, in the library's own packing.

use super::map::{Context, Map, Shape, failed};
use super::passes::{Change, GroupNorm, Target, interleave, prepared};
use crate::config::Border;
use crate::error::ModelError;
use crate::network::loader::Place;
use sat3d_onednn::{
    After, Algorithm, Convolution, ConvolutionSpec, Element, Error, Layout, Library, Memory, Order,
    Product, Session, View,
};

/// How convolutions of a network are calculated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Numerics {
    pub element: Element,
    pub order: Order,
    pub algorithm: Algorithm,
}

impl GroupNorm {
    pub(super) fn load(place: &Place<'_>, channels: usize) -> Result<Self, ModelError> {
        Ok(Self { gain: place.read("weight", [channels])?, shift: place.read("bias", [channels])? })
    }
}

/// A convolution that keeps the size of its input.
#[derive(Debug)]
pub(super) struct Conv {
    convolution: Convolution,
    weights: Memory,
    bias: Vec<f32>,
    outputs: usize,
    order: Order,
    /// What it reads.
    target: Target,
}

/// A convolution's sizes.
#[derive(Clone, Copy, Debug)]
pub(super) struct ConvShape {
    pub inputs: usize,
    pub outputs: usize,
    /// Pixels along a side of the map.
    pub side: usize,
    /// Pixels along a side of the kernel: 1 or 3.
    pub kernel: usize,
    pub border: Border,
    /// Whether the result is added to what is there.
    pub sum: bool,
}

impl Conv {
    pub(super) fn load(
        library: &'static Library,
        place: &Place<'_>,
        shape: ConvShape,
        numerics: Numerics,
    ) -> Result<Self, ModelError> {
        let ConvShape { inputs, outputs, side, kernel, border, sum } = shape;
        let target = match kernel {
            1 => Target::plain(numerics.element),
            _ => Target::bordered(numerics.element, border),
        };
        let zeros = if target.wrapped { 0 } else { kernel / 2 };
        let spec = ConvolutionSpec {
            batch: 1,
            inputs,
            outputs,
            size: target.size([side; 2]),
            kernel: [kernel; 2],
            before: [zeros; 2],
            after: [zeros; 2],
            element: numerics.element,
            order: numerics.order,
            algorithm: if kernel == 3 { numerics.algorithm } else { Algorithm::Direct },
            sum,
        };
        let read = || place.read("weight", [outputs, inputs, kernel, kernel]);
        let (convolution, weights) = compiled(library, &spec, (place, "weight"), read)?;
        let bias = place.read("bias", [outputs])?;
        Ok(Self { convolution, weights, bias, outputs, order: numerics.order, target })
    }

    /// Convolves a map, changed on its way, into a new one.
    pub(super) fn forward(
        &self,
        context: &mut Context,
        map: &Map,
        change: &Change<'_>,
    ) -> Result<Map, ModelError> {
        let shape = Shape { channels: self.outputs, ..map.shape };
        let mut result = Map::take(context, shape, self.order)?;
        self.add(context, map, change, &mut result)?;
        Ok(result)
    }

    /// The same into a map that is there, to which it is added where the convolution was made so.
    pub(super) fn add(
        &self,
        context: &mut Context,
        map: &Map,
        change: &Change<'_>,
        result: &mut Map,
    ) -> Result<(), ModelError> {
        // What is read as it is needs no pass.
        let straight = matches!(change, Change::Copy) && self.target == Target::plain(Element::F32);
        let copy = if straight { None } else { Some(prepared(context, map, change, self.target)?) };
        let source = copy.as_ref().unwrap_or(&map.memory).view();
        let (weights, bias) = (&self.weights, self.bias.as_slice());
        let session = &mut context.session;
        self.convolution
            .run(session, source, weights, bias, &mut result.memory)
            .map_err(failed("convolution"))?;
        if let Some(copy) = copy {
            context.put(copy);
        }
        Ok(())
    }
}

/// The convolution with its weights packed; Winograd's where it exists for these sizes, else the direct one. Weights
/// that a former run packed under the same name for the same layout are not read and packed again.
fn compiled(
    library: &'static Library,
    spec: &ConvolutionSpec,
    (place, name): (&Place<'_>, &str),
    read: impl FnOnce() -> Result<Vec<f32>, ModelError>,
) -> Result<(Convolution, Memory), ModelError> {
    let made = match Convolution::new(library, spec) {
        Err(Error::Unimplemented { .. }) if spec.algorithm == Algorithm::Winograd => {
            Convolution::new(library, &ConvolutionSpec { algorithm: Algorithm::Direct, ..*spec })
        }
        made => made,
    };
    let failed = failed("convolution");
    let convolution = made.map_err(&failed)?;
    let (key, layout) = (place.key(name), convolution.weights());
    // The transforms of Winograd's take seconds; other orders are made as fast as they would be read.
    let slow = spec.algorithm == Algorithm::Winograd;
    let kept = place.packed().filter(|_| slow).map(|packed| (packed, layout.fingerprint()));
    if let Some((packed, fingerprint)) = &kept {
        let mut weights = Memory::new(layout);
        if packed.recall(&key, fingerprint, weights.floats_mut()) {
            return Ok((convolution, weights));
        }
    }
    // A session of its own: layers are loaded side by side.
    let mut session = Session::new(library).map_err(&failed)?;
    let weights = convolution.pack(&mut session, &read()?).map_err(&failed)?;
    if let Some((packed, fingerprint)) = &kept {
        packed.keep(&key, fingerprint, weights.floats());
    }
    Ok((convolution, weights))
}

/// A doubling of the map, each pixel becoming four, and a 3 x 3 convolution after it.
#[derive(Debug)]
pub(super) enum Upsample {
    /// As it is written.
    Plain(Box<Conv>),
    /// As four convolutions of 2 x 2 of the smaller map, for even and odd rows and columns: each pixel of the doubled
    /// map's neighbourhood is one of two by two, and weights that meet the same pixel are added. 16 products for four
    /// pixels instead of 36.
    Phases { phases: Box<[(Convolution, Memory); 4]>, bias: Vec<f32>, element: Element },
}

impl Upsample {
    /// `side` is that of the smaller map.
    pub(super) fn load(
        library: &'static Library,
        place: &Place<'_>,
        (width, side): (usize, usize),
        numerics: Numerics,
    ) -> Result<Self, ModelError> {
        if numerics.algorithm == Algorithm::Winograd {
            let border = Border::Zeros;
            let (inputs, outputs) = (width, width);
            let shape =
                ConvShape { inputs, outputs, side: 2 * side, kernel: 3, border, sum: false };
            let mut conv = Conv::load(library, place, shape, numerics)?;
            conv.target.doubled = true;
            return Ok(Self::Plain(Box::new(conv)));
        }
        let phase = |index: usize| {
            let odd = [index / 2, index % 2];
            let spec = ConvolutionSpec {
                batch: 1,
                inputs: width,
                outputs: width,
                size: [side; 2],
                kernel: [2; 2],
                before: odd.map(|odd| 1 - odd),
                after: odd,
                element: numerics.element,
                order: numerics.order,
                algorithm: Algorithm::Direct,
                sum: false,
            };
            let read = || {
                let weights = place.read("weight", [width, width, 3, 3])?;
                Ok(phase_weights(&weights, odd))
            };
            let name = format!("weight, rows {} and columns {}", odd[0], odd[1]);
            compiled(library, &spec, (place, &name), read)
        };
        Ok(Self::Phases {
            phases: Box::new([phase(0)?, phase(1)?, phase(2)?, phase(3)?]),
            bias: place.read("bias", [width])?,
            element: numerics.element,
        })
    }

    pub(super) fn forward(&self, context: &mut Context, map: &Map) -> Result<Map, ModelError> {
        let shape = Shape { height: 2 * map.shape.height, width: 2 * map.shape.width, ..map.shape };
        let mut result = Map::take(context, shape, map.order)?;
        let (phases, bias, element) = match self {
            Self::Plain(conv) => {
                conv.add(context, map, &Change::Copy, &mut result)?;
                return Ok(result);
            }
            Self::Phases { phases, bias, element } => (phases, bias, *element),
        };
        let copy = match element {
            Element::F32 => None,
            Element::Bf16 => Some(prepared(context, map, &Change::Copy, Target::plain(element))?),
        };
        let mut phase = |(convolution, weights): &(Convolution, Memory)| {
            let mut part = Map::take(context, map.shape, map.order)?;
            let source = copy.as_ref().unwrap_or(&map.memory).view();
            convolution
                .run(&mut context.session, source, weights, bias, &mut part.memory)
                .map_err(failed("convolution"))?;
            Ok::<_, ModelError>(part)
        };
        let [a, b, c, d] = phases.as_ref();
        let parts = [phase(a)?, phase(b)?, phase(c)?, phase(d)?];
        interleave(&parts, &mut result);
        for part in parts {
            context.put(part.memory);
        }
        if let Some(copy) = copy {
            context.put(copy);
        }
        Ok(result)
    }
}

/// Weights that meet the same pixel of the smaller map, added. An even row sees its pixel's predecessor once and the
/// pixel itself twice; an odd one the pixel twice and its successor once.
pub(super) fn phase_weights(weights: &[f32], odd: [usize; 2]) -> Vec<f32> {
    let taps = |odd: usize, at: usize| match (odd, at) {
        (0, 0) => 0..1,
        (0, _) => 1..3,
        (_, 0) => 0..2,
        _ => 2..3,
    };
    let mut phase = Vec::with_capacity(weights.len() / 9 * 4);
    for kernel in weights.chunks_exact(9) {
        for row in 0..2 {
            for column in 0..2 {
                let mut sum = 0.0_f64;
                for y in taps(odd[0], row) {
                    for x in taps(odd[1], column) {
                        sum += f64::from(kernel[3 * y + x]);
                    }
                }
                phase.push(sum as f32);
            }
        }
    }
    phase
}

/// Rows times constant weights, which are stored as `outputs x inputs`.
#[derive(Debug)]
pub(super) struct Dense {
    weights: Held,
    bias: Vec<f32>,
}

#[derive(Debug)]
enum Held {
    /// Packed for the product.
    Packed(Box<Memory>),
    /// As stored.
    Plain(Vec<f32>),
    /// In the mapped file, by its key.
    Mapped(String),
}

/// The product that dense layers of the same sizes share.
#[derive(Debug)]
pub(super) struct DenseProduct {
    product: Product,
    source: Layout,
    turned: Layout,
    inputs: usize,
    outputs: usize,
    element: Element,
    pub result: Layout,
}

impl DenseProduct {
    /// For so many rows; `gelu` after it, in which case the result is of the same type as the rows.
    pub(super) fn new(
        library: &'static Library,
        rows: usize,
        (inputs, outputs): (usize, usize),
        element: Element,
        gelu: bool,
    ) -> Result<Self, ModelError> {
        let make = || {
            let source = Layout::dense(library, &[rows, inputs], element)?;
            let into = if gelu { element } else { Element::F32 };
            let result = Layout::dense(library, &[rows, outputs], into)?;
            let turned = Layout::strided(library, &[inputs, outputs], Element::F32, &[1, inputs])?;
            let after = After { gelu, sum: false };
            // Plain weights are multiplied as fast as packed ones, and need not be copied.
            let product = match element {
                Element::F32 => {
                    Product::new(library, source, turned, Some(outputs), result, after)?
                }
                Element::Bf16 => {
                    Product::packed(library, source, (inputs, outputs, element), result, after)?
                }
            };
            Ok(Self { product, source, turned, inputs, outputs, element, result })
        };
        make().map_err(failed("dense layer"))
    }
}

impl DenseProduct {
    /// Rows of 32-bit floats to be multiplied.
    pub(super) fn rows<'a>(&self, values: &'a [f32]) -> Result<View<'a>, ModelError> {
        View::of(self.source, values).map_err(failed("dense layer"))
    }
}

impl Dense {
    pub(super) fn load(
        product: &DenseProduct,
        place: &Place<'_>,
        bias: bool,
    ) -> Result<Self, ModelError> {
        let DenseProduct { inputs, outputs, element, turned, .. } = product;
        let shape = [*outputs, *inputs];
        let weights = match element {
            Element::F32 => match place.mapped("weight", shape) {
                Some(_) => Held::Mapped(place.key("weight")),
                None => Held::Plain(place.read("weight", shape)?),
            },
            Element::Bf16 => {
                let stored = place.read("weight", shape)?;
                let failed = failed("dense layer");
                let mut session = Session::new(turned.library()).map_err(&failed)?;
                let view = View::of(*turned, &stored).map_err(&failed)?;
                Held::Packed(Box::new(product.product.pack(&mut session, view).map_err(&failed)?))
            }
        };
        let bias = if bias { place.read("bias", [*outputs])? } else { vec![0.0; *outputs] };
        Ok(Self { weights, bias })
    }

    /// Weights and bias from memory.
    pub(super) fn of(weights: Vec<f32>, bias: Vec<f32>) -> Self {
        Self { weights: Held::Plain(weights), bias }
    }

    /// `root` is where the keys of mapped weights begin.
    pub(super) fn forward(
        &self,
        context: &mut Context,
        product: &DenseProduct,
        root: Option<&Place<'_>>,
        rows: View<'_>,
    ) -> Result<Memory, ModelError> {
        let mut result = context.take(product.result);
        let failed = failed("dense layer");
        let plain = match &self.weights {
            Held::Packed(_) => &[],
            Held::Plain(values) => values.as_slice(),
            Held::Mapped(key) => {
                let shape = [product.outputs, product.inputs];
                root.and_then(|root| root.mapped(key, shape)).unwrap_or_default()
            }
        };
        let weights = match &self.weights {
            Held::Packed(memory) => memory.view(),
            _ => View::of(product.turned, plain).map_err(&failed)?,
        };
        let session = &mut context.session;
        product.product.run(session, rows, weights, &self.bias, &mut result).map_err(&failed)?;
        if let (Held::Mapped(key), Some(root)) = (&self.weights, root) {
            // All layers together are 1.2 GB, each of which is read once per image.
            root.release(key);
        }
        Ok(result)
    }
}
