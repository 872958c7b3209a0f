use super::*;
use crate::field::{Field, FieldInputs, PointHead};
use crate::random;
use crate::tensor::Grid;
use crate::weights::TensorSource;
use burn::tensor::{Gradients, TensorData};

/// Numbers for any key, of a size that lets densities vary.
struct Numbers(u64);

impl TensorSource for Numbers {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        let count: usize = shape.iter().product();
        let inputs = shape.iter().skip(1).product::<usize>().max(1) as f64;
        let name: Vec<u64> = key.bytes().map(u64::from).chain([self.0]).collect();
        let scale = (3.0 / inputs).sqrt();
        let mut draw = random::Draw::new(&name);
        Ok((0..count).map(|_| draw.range(-scale, scale) as f32).collect())
    }
}

const SIZES: HeadSizes = HeadSizes { features: 0, hidden: 20, style: 5, colors: 7 };

/// A random field both ways: as it is rendered, and as it is trained.
pub(crate) fn both(
    representation: Representation,
    activation: DensityActivation,
    style: Option<Vec<f32>>,
) -> (Field, FieldTensors, Tensor<2>) {
    let device = Device::flex().autodiff();
    let (source, sizes, map) = parts(representation);
    let head = Head::load(&Loader::new(&source, &device).child("mlp"), sizes).expect("a head");
    let shape = [map.channels, map.height, map.width];
    let tensor = Tensor::from_data(TensorData::new(map.data.clone(), shape), &device);
    let code = style.clone().map(|style| {
        let length = style.len();
        Tensor::from_data(TensorData::new(style, [1, length]), &device)
    });
    let tint = head.tint(code);
    let tensors = FieldTensors::new(tensor, &head, representation, activation);
    let inputs = FieldInputs { map, representation, activation, scale: 0.8 };
    let plain = plain_head(&source, sizes);
    (Field::new(&inputs, &plain, style.as_deref()).expect("a field"), tensors, tint)
}

fn parts(representation: Representation) -> (Numbers, HeadSizes, Grid) {
    let source = Numbers(5);
    let channels = 12;
    let features = match representation {
        Representation::Oneplane => channels,
        Representation::OneplaneMulti => channels / 2,
        Representation::Triplane => channels / 3,
    };
    let side = 9;
    let data = source.read("map", &[channels * side * side]).expect("numbers");
    let data = data.iter().map(|value| 6.0 * value).collect();
    (source, HeadSizes { features, ..SIZES }, Grid::new(channels, side, side, data))
}

fn plain_head(source: &Numbers, sizes: HeadSizes) -> PointHead {
    let linear = |name: &str, inputs: usize, outputs: usize| crate::field::Linear {
        inputs,
        outputs,
        weight: source.read(&format!("mlp.{name}.weight"), &[outputs, inputs]).expect("numbers"),
        bias: source.read(&format!("mlp.{name}.bias"), &[outputs]).expect("numbers"),
    };
    let HeadSizes { features, hidden, style, colors } = sizes;
    PointHead {
        net0: linear("net0", features, hidden),
        density: linear("net1_density", hidden, 1),
        feature: linear("net1_feature", hidden, hidden / 2),
        style: linear("style_squ", style, hidden / 2),
        color: linear("grd_color_convert", hidden, colors),
    }
}

pub(crate) const REPRESENTATIONS: [Representation; 3] =
    [Representation::Oneplane, Representation::OneplaneMulti, Representation::Triplane];

fn values(tensor: Tensor<2>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

/// Points inside, on the rim and outside of the cube.
fn points() -> Vec<[f32; 3]> {
    let mut draw = random::Draw::new(&[1]);
    let mut points: Vec<[f32; 3]> =
        (0..300).map(|_| [0, 1, 2].map(|_| draw.range(-1.3, 1.3) as f32)).collect();
    points.extend([[1.0, -1.0, 1.0], [0.0; 3], [f32::NAN, 0.0, 0.0], [1e9, -1e9, 0.5]]);
    points
}

impl FieldTensors {
    /// The same with another bias of the density.
    pub(crate) fn shifted(mut self, by: f32) -> Self {
        let bias = self.density.bias.as_ref().expect("a bias").val();
        let value: f32 = bias.clone().into_scalar();
        let data = TensorData::new(vec![value + by], [1]);
        self.density.bias = Some(burn::module::Param::from_data(data, &bias.device()));
        self
    }

    pub(crate) fn density_bias_gradient(&self, gradients: &Gradients) -> f32 {
        let bias = self.density.bias.as_ref().expect("a bias").val();
        bias.grad(gradients).expect("a gradient").into_scalar()
    }
}

#[test]
fn points_are_as_in_the_field_that_is_rendered() {
    for representation in REPRESENTATIONS {
        for activation in [DensityActivation::Mipnerf, DensityActivation::Relu] {
            let (field, tensors, tint) = both(representation, activation, Some(vec![0.5; 5]));
            let points = points();
            let hidden = tensors.hidden(Points::Scattered(&points));
            let raw = values(tensors.raw(hidden.clone()));
            let colors = values(tensors.colors(hidden, &tint));
            let (densities, wanted) = field.densities_and_colors(&points);
            let own = values(tensors.densities(&points));
            for (index, point) in points.iter().enumerate() {
                let exact = field.raw_densities(&[*point])[0];
                assert!(
                    (raw[index] - exact).abs() < 1e-5 * exact.abs().max(1.0),
                    "{point:?}: {} {exact}",
                    raw[index]
                );
                assert!(
                    (own[index] - densities[index]).abs() < 1e-5 * densities[index].max(1.0),
                    "{point:?}"
                );
            }
            assert_eq!(colors.len(), wanted.len());
            let worst = colors.iter().zip(&wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-5, "{representation:?}: colours err {worst}");
        }
    }
}

#[test]
fn columns_are_as_their_points() {
    for representation in REPRESENTATIONS {
        let (_, tensors, _) = both(representation, DensityActivation::Mipnerf, None);
        let places = [[0.3, -0.4], [-0.9, 0.95], [0.0, 0.0]];
        let heights: Vec<f32> = (0..15).map(|k| k as f32 / 7.0 - 1.0).collect();
        let points: Vec<[f32; 3]> = heights
            .iter()
            .enumerate()
            .map(|(k, z)| [places[k / 5][0], places[k / 5][1], *z])
            .collect();
        let columns = tensors.hidden(Points::Columns { places: &places, heights: &heights });
        let scattered = tensors.hidden(Points::Scattered(&points));
        for (a, b) in values(columns).iter().zip(values(scattered)) {
            assert!((a - b).abs() < 1e-6, "{representation:?}: {a} {b}");
        }
    }
}

/// Squares of densities and colours. The gradient of their sum is held against differences.
fn objective(map: Tensor<3>, head: &Head, representation: Representation) -> Tensor<2> {
    let field = FieldTensors::new(map, head, representation, DensityActivation::Mipnerf);
    let points: Vec<[f32; 3]> = points().into_iter().take(60).collect();
    let hidden = field.hidden(Points::Scattered(&points));
    let device = field.device();
    let style = Tensor::full([1, 5], 0.3, &device);
    let colors = field.colors(hidden.clone(), &head.tint(Some(style)));
    let sigma = activate(field.activation(), field.raw(hidden));
    Tensor::cat(vec![sigma, colors], 1).powi_scalar(2)
}

#[test]
fn gradients_agree_with_differences() {
    for representation in REPRESENTATIONS {
        let device = Device::flex().autodiff();
        let (source, sizes, grid) = parts(representation);
        let head = Head::load(&Loader::new(&source, &device).child("mlp"), sizes).expect("a head");
        let shape = [grid.channels, grid.height, grid.width];
        let tensor = |data: Vec<f32>| {
            Tensor::<3>::from_data(TensorData::new(data, shape), &device).require_grad()
        };
        let map = tensor(grid.data.clone());
        let gradients: Gradients = objective(map.clone(), &head, representation).sum().backward();
        let found: Vec<f32> =
            map.grad(&gradients).expect("a gradient").into_data().iter::<f32>().collect();
        let at = |data: Vec<f32>| -> f64 {
            let terms = values(objective(tensor(data), &head, representation));
            terms.into_iter().map(f64::from).sum()
        };
        // Along random directions: single texels' differences drown in single precision.
        let mut draw = random::Draw::new(&[3]);
        for _ in 0..4 {
            let direction: Vec<f64> = (0..found.len()).map(|_| draw.range(-1.0, 1.0)).collect();
            let moved = |step: f64| {
                let data = grid.data.iter().zip(&direction);
                at(data.map(|(value, by)| (f64::from(*value) + step * by) as f32).collect())
            };
            let step = 4e-3;
            let difference = (moved(step) - moved(-step)) / (2.0 * step);
            let exact: f64 = found.iter().zip(&direction).map(|(g, d)| f64::from(*g) * d).sum();
            let close = (difference - exact).abs() < 2e-3 * exact.abs().max(1.0);
            assert!(close, "{representation:?}: {exact}, by differences {difference}");
        }
        for parameter in [&head.net0, &head.net1_feature, &head.net1_density, &head.style_squ] {
            let gradient = parameter.weight.val().grad(&gradients).expect("a gradient");
            let largest: f32 = gradient.abs().max().into_scalar();
            assert!(largest.is_finite() && largest > 0.0, "{largest}");
        }
    }
}

#[test]
fn softplus_has_a_gradient_everywhere() {
    let device = Device::flex().autodiff();
    let input = Tensor::<1>::from_floats([-200.0, -30.0, 0.0, 30.0, 200.0], &device).require_grad();
    let output = softplus(input.clone());
    let gradient = input.grad(&output.clone().sum().backward()).expect("a gradient");
    let output: Vec<f32> = output.into_data().iter::<f32>().collect();
    let gradient: Vec<f32> = gradient.into_data().iter::<f32>().collect();
    assert!(output[0].abs() < 1e-30 && output[4] == 200.0, "{output:?}");
    assert!((output[2] - std::f32::consts::LN_2).abs() < 1e-6, "{output:?}");
    assert!((gradient[2] - 0.5).abs() < 1e-6 && gradient[4] == 1.0, "{gradient:?}");
    assert!(gradient.iter().all(|value| value.is_finite()), "{gradient:?}");
}
