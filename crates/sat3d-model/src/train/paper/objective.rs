//! The generator's loss: renders a batch and adds up its terms.

use super::super::TrainError;
use super::super::field::FieldTensors;
use super::super::generator::{Generator, Light, MapNetwork, Shape, View};
use super::super::losses::{depth, gravity, photometric, sky};
use super::super::rays::{Purpose, Rays, draw, random_window};
use super::super::render::Samples;
use super::super::targets::{StreetTargets, Targets, batch, halved};
use super::settings::{Form, PaperSettings, Photometric};
use super::{Critics, Distance};
use crate::network::unet::Statistics;
use crate::random::key;
use crate::render::Camera;
use crate::render::frames::from_crop;
use crate::tensor::Grid;
use burn::tensor::{Device, Tensor};

/// What discriminators are shown: pictures in [-1, 1], where there are any.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pictures {
    /// Satellite view, panorama, perspective view.
    pub views: [Option<Tensor<4>>; 3],
}

/// The terms of a step, weights included, and what was rendered.
pub(crate) struct Judged {
    pub terms: Vec<(&'static str, Tensor<1>)>,
    pub rendered: Pictures,
    /// What the map network's norms met.
    pub statistics: Statistics,
}

/// Everything that a step of the generator is made of.
pub(crate) struct Objective<'a, M> {
    pub settings: &'a PaperSettings,
    pub shape: &'a Shape,
    pub generator: &'a Generator<M>,
    pub critics: &'a Critics,
    pub perceptual: Option<&'a Distance>,
    pub device: &'a Device,
    pub step: u64,
}

/// The views of a batch; street views of those images alone that have one.
struct Views {
    above: Option<Tensors>,
    panorama: Option<Tensors>,
    perspective: Option<Tensors>,
}

/// The views of several images, one after the other.
struct Tensors {
    depth: Tensor<4>,
    opacity: Tensor<4>,
    colors: Tensor<4>,
    sky: Option<Tensor<4>>,
    sharp: Option<Tensor<4>>,
}

impl Tensors {
    fn new(views: Vec<View>) -> Option<Self> {
        if views.is_empty() {
            return None;
        }
        let join = |part: &dyn Fn(&View) -> Tensor<4>| {
            Tensor::cat(views.iter().map(part).collect::<Vec<_>>(), 0)
        };
        let joined = |part: &dyn Fn(&View) -> Option<Tensor<4>>| {
            let parts: Option<Vec<_>> = views.iter().map(part).collect();
            parts.map(|parts| Tensor::cat(parts, 0))
        };
        Some(Self {
            depth: join(&|view| view.depth.clone()),
            opacity: join(&|view| view.opacity.clone()),
            colors: join(&|view| view.colors.clone()),
            sky: joined(&|view| view.sky.clone()),
            sharp: joined(&|view| view.sharp.clone()),
        })
    }

    /// Red, green and blue in [-1, 1].
    fn rgb(&self) -> Tensor<4> {
        signed(self.colors.clone().narrow(1, 0, 3))
    }

    /// What is compared with the true picture: the sharpened view, where there is one.
    fn shown(&self) -> Tensor<4> {
        self.sharp.clone().map_or_else(|| self.rgb(), signed)
    }
}

fn signed(unit: Tensor<4>) -> Tensor<4> {
    unit * 2.0 - 1.0
}

impl<M: MapNetwork> Objective<'_, M> {
    /// Renders the batch and judges it.
    pub(crate) fn judge(&self, targets: &[Targets]) -> Judged {
        let inputs = batch(targets.iter().map(|target| &target.input), self.device);
        let mut statistics = Vec::new();
        let fields = self.generator.fields(self.shape, inputs, &mut statistics);
        let window = random_window(
            &self.settings.views,
            draw(self.settings.seed, self.step, Purpose::Window, &[]),
        );
        let views = self.render(targets, &fields, window);
        let mut terms = Vec::new();
        let satellite = crop(self.satellites(targets), window, self.settings.views.ortho_window);
        if let Some(above) = &views.above {
            self.above(above, satellite, targets, window, &mut terms);
        }
        let streets: Vec<&StreetTargets> =
            targets.iter().filter_map(|target| target.street.as_ref()).collect();
        let weights = &self.settings.weights;
        if let Some(panorama) = &views.panorama {
            let truth = self.of(&streets, |street| &street.panorama);
            let shared = ("panorama", "panorama.raw");
            self.street(panorama, &truth, weights.panorama, shared, &mut terms);
            self.sky(panorama, truth, &streets, &mut terms);
        }
        if let Some(perspective) = &views.perspective {
            let truth = self.of(&streets, |street| &street.perspective);
            let shared = ("perspective", "perspective.raw");
            self.street(perspective, &truth, weights.perspective, shared, &mut terms);
        }
        let rendered = Pictures {
            views: [
                views.above.as_ref().filter(|_| self.colors_above()).map(Tensors::rgb),
                views.panorama.as_ref().map(Tensors::shown),
                views.perspective.as_ref().map(Tensors::shown),
            ],
        };
        self.adversarial(&rendered, &mut terms);
        self.gravity(&fields, &mut terms);
        let rendered = Pictures { views: rendered.views.map(|view| view.map(Tensor::detach)) };
        Judged { terms, rendered, statistics }
    }

    fn colors_above(&self) -> bool {
        let weights = &self.settings.weights;
        !weights.satellite.is_off() || weights.adversarial.satellite > 0.0
    }

    fn render(&self, targets: &[Targets], fields: &[FieldTensors], window: [usize; 2]) -> Views {
        let PaperSettings { views, weights, composite, .. } = self.settings;
        let from_above = self.colors_above()
            || weights.ortho_opacity > 0.0
            || (weights.depth > 0.0 && targets.iter().any(|target| target.depth.is_some()));
        let panorama = !weights.panorama.is_off()
            || weights.adversarial.panorama > 0.0
            || weights.opacity > 0.0
            || weights.sky_colour > 0.0
            || weights.mean_sky_colour > 0.0;
        let perspective = !weights.perspective.is_off() || weights.adversarial.perspective > 0.0;
        let (mut above, mut around, mut ahead) = (Vec::new(), Vec::new(), Vec::new());
        let scale = self.shape.scale;
        let camera = Camera::Ortho { size: views.ortho_grid };
        let down = Rays::window(&camera, scale, window, [views.ortho_window; 2]);
        let overhead = self.colors_above().then(|| self.generator.overhead());
        for (image, (target, field)) in targets.iter().zip(fields).enumerate() {
            if from_above {
                let samples = self.samples(image, 0);
                above.push(self.generator.above(field, &down, samples, overhead.as_ref()));
            }
            let Some(street) = &target.street else { continue };
            if !(panorama || perspective) {
                continue;
            }
            let light: Light = self.generator.light(&street.histogram, street.sky_mean, self.shape);
            let view = |camera: &Camera, kind: u64| {
                let rays = Rays::of_camera(camera, scale);
                let samples = self.samples(image, kind);
                self.generator.street(field, &rays, samples, &light, *composite)
            };
            if panorama {
                let position = from_crop(street.position, scale);
                let (width, height) = (views.panorama_width, views.panorama_height);
                around.push(view(&Camera::Panorama { width, height, position }, 1));
            }
            if perspective {
                let side = views.perspective * self.enlarged();
                let camera = street.look.camera(side, self.enlarged(), street.position, scale);
                ahead.push(view(&camera, 2));
            }
        }
        Views {
            above: Tensors::new(above),
            panorama: Tensors::new(around),
            perspective: Tensors::new(ahead),
        }
    }

    /// Pixels of a shown street view for each ray, along one side.
    fn enlarged(&self) -> usize {
        if self.generator.sharp.is_some() { self.shape.enlarged } else { 1 }
    }

    fn samples(&self, image: usize, view: u64) -> Samples {
        let PaperSettings { views, seed, .. } = self.settings;
        let name = key(&[*seed, Purpose::Jitter as u64, self.step, image as u64, view]);
        Samples {
            coarse: views.coarse_samples,
            fine: views.fine_samples,
            jitter: views.jitter.then_some(name),
        }
    }

    fn satellites(&self, targets: &[Targets]) -> Tensor<4> {
        batch(targets.iter().map(|target| &target.satellite), self.device)
    }

    fn of(&self, streets: &[&StreetTargets], part: impl Fn(&StreetTargets) -> &Grid) -> Tensor<4> {
        batch(streets.iter().map(|street| part(street)), self.device)
    }

    /// The terms of the satellite view.
    fn above(
        &self,
        view: &Tensors,
        truth: Tensor<4>,
        targets: &[Targets],
        window: [usize; 2],
        terms: &mut Vec<(&'static str, Tensor<1>)>,
    ) {
        let weights = &self.settings.weights;
        if !weights.satellite.is_off() {
            terms.push(("satellite", self.photometric(&weights.satellite, view.rgb(), truth)));
        }
        if weights.ortho_opacity > 0.0 {
            let term = sky::ortho_opacity(view.opacity.clone(), &self.settings.opacity());
            terms.push(("ortho_opacity", term * weights.ortho_opacity));
        }
        let labelled: Vec<usize> =
            (0..targets.len()).filter(|image| targets[*image].depth.is_some()).collect();
        if weights.depth > 0.0 && !labelled.is_empty() {
            let labels = batch(targets.iter().filter_map(|t| t.depth.as_ref()), self.device);
            let labels = crop(labels, window, self.settings.views.ortho_window);
            let depths = labelled.iter().map(|image| view.depth.clone().narrow(0, *image, 1));
            let depths = Tensor::cat(depths.collect(), 0);
            let term = depth::satellite_depth(depths, labels, &self.settings.depth()).total;
            terms.push(("depth", term * weights.depth));
        }
    }

    /// The photometric terms of a street view.
    fn street(
        &self,
        view: &Tensors,
        truth: &Tensor<4>,
        weight: Photometric,
        (name, raw_name): (&'static str, &'static str),
        terms: &mut Vec<(&'static str, Tensor<1>)>,
    ) {
        if weight.is_off() {
            return;
        }
        terms.push((name, self.photometric(&weight, view.shown(), truth.clone())));
        let raw = self.settings.weights.raw_view;
        if view.sharp.is_some() && !raw.is_off() {
            // The sharpened view is not detached: both are drawn to each other.
            let raw = Photometric { weight: weight.weight * raw.weight, ..raw };
            terms.push((raw_name, self.photometric(&raw, view.rgb(), halved(view.shown()))));
        }
    }

    /// The terms of the panorama's sky.
    fn sky(
        &self,
        view: &Tensors,
        truth: Tensor<4>,
        streets: &[&StreetTargets],
        terms: &mut Vec<(&'static str, Tensor<1>)>,
    ) {
        let PaperSettings { weights, sky_form, .. } = self.settings;
        let mask = self.of(streets, |street| &street.sky);
        if weights.opacity > 0.0 {
            let form = self.settings.opacity();
            let term = sky::opacity(view.opacity.clone(), mask.clone(), &form);
            terms.push(("opacity", term * weights.opacity));
        }
        let constants = sky::SkyColour::release();
        let truth = if self.enlarged() == 2 { halved(truth) } else { truth };
        let map = view.sky.as_ref().filter(|_| self.generator.sky_decoder.is_some());
        let predicted = match sky_form {
            Form::Release => map.map(|sky| signed(sky.clone().narrow(1, 0, 3))),
            Form::Paper => Some(view.rgb()),
        };
        if let Some(predicted) = predicted.filter(|_| weights.sky_colour > 0.0) {
            let term = sky::sky_colour(predicted, truth.clone(), mask.clone(), &constants);
            terms.push(("sky_colour", term * weights.sky_colour));
        }
        if let Some(sky) = map.filter(|_| weights.mean_sky_colour > 0.0) {
            let predicted = sky.clone().narrow(1, 0, 3);
            let truth = (truth + 1.0) / 2.0;
            let term = sky::mean_sky_colour(predicted, truth, mask, &constants);
            terms.push(("mean_sky_colour", term * weights.mean_sky_colour));
        }
    }

    fn photometric(&self, of: &Photometric, predicted: Tensor<4>, truth: Tensor<4>) -> Tensor<1> {
        let mut parts: Vec<Tensor<1>> = Vec::new();
        if of.l1 > 0.0 {
            parts.push(photometric::l1(predicted.clone(), truth.clone()) * of.l1);
        }
        if of.l2 > 0.0 {
            parts.push(photometric::l2(predicted.clone(), truth.clone()) * of.l2);
        }
        // That there is one where it is wanted was checked with the settings.
        if let Some(distance) = self.perceptual.filter(|_| of.perceptual > 0.0) {
            parts.push(distance(predicted, truth) * of.perceptual);
        }
        Tensor::cat(parts, 0).sum() * of.weight
    }

    fn adversarial(&self, rendered: &Pictures, terms: &mut Vec<(&'static str, Tensor<1>)>) {
        const NAMES: [&str; 3] =
            ["adversarial.satellite", "adversarial.panorama", "adversarial.perspective"];
        let game = self.settings.game();
        let weights = self.settings.weights.adversarial.list();
        for (place, weight) in weights.into_iter().enumerate() {
            let (Some(critic), Some(picture)) =
                (&self.critics.views[place], &rendered.views[place])
            else {
                continue;
            };
            let scores = critic.frozen().score(picture.clone());
            terms.push((NAMES[place], game.generator(scores) * weight));
        }
    }

    fn gravity(&self, fields: &[FieldTensors], terms: &mut Vec<(&'static str, Tensor<1>)>) {
        let weight = self.settings.weights.gravity;
        if weight == 0.0 {
            return;
        }
        let options = self.settings.gravity();
        let plain = self.device.clone().without_autodiff();
        let pairs = options.pairs(fields.len(), self.settings.seed, self.step, &plain);
        let [lower, upper] = pairs.map(|points| {
            let points: Vec<f32> = points.into_data().iter::<f32>().collect();
            let points = points.as_chunks::<3>().0;
            let of_images = fields.iter().zip(points.chunks(options.points));
            let densities = of_images.map(|(field, points)| field.densities(points));
            Tensor::cat(densities.collect(), 0)
        });
        terms.push(("gravity", gravity::gravity(lower, upper, &options) * weight));
    }
}

/// A square window of pictures.
pub(crate) fn crop(pictures: Tensor<4>, [top, left]: [usize; 2], side: usize) -> Tensor<4> {
    pictures.narrow(2, top, side).narrow(3, left, side)
}

/// The value of a term, or an error where the device fails.
pub(crate) fn scalar(term: &Tensor<1>) -> Result<f32, TrainError> {
    term.clone().try_into_scalar::<f32>().map_err(|error| {
        crate::error::ModelError::Backend { stage: "training", why: error.to_string() }.into()
    })
}
