//! Maps in the order in which convolutions read them, and the memory that they take turns in.

use crate::error::ModelError;
use crate::tensor::Grid;
use rayon::prelude::*;
use sat3d_onednn::{Arena, BLOCK, Element, Error, Layout, Library, Memory, Order, Session};

/// An error of the library as one of a stage.
pub(super) fn failed(stage: &'static str) -> impl Fn(Error) -> ModelError {
    move |error| ModelError::Backend { stage, why: error.to_string() }
}

/// What operations are run with.
#[derive(Debug)]
pub(super) struct Context {
    pub session: Session,
    arena: Arena,
}

impl Context {
    pub(super) fn new(library: &'static Library) -> Result<Self, ModelError> {
        Ok(Self {
            session: Session::new(library).map_err(failed("oneDNN"))?,
            arena: Arena::default(),
        })
    }

    pub(super) fn library(&self) -> &'static Library {
        self.session.library()
    }

    /// A memory with any values in it.
    pub(super) fn take(&mut self, layout: Layout) -> Memory {
        self.arena.take(layout)
    }

    /// Gives a memory back.
    pub(super) fn put(&mut self, memory: Memory) {
        self.arena.put(memory);
    }
}

/// Sizes of a map of one image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    pub channels: usize,
    pub height: usize,
    pub width: usize,
}

impl Shape {
    pub(super) fn layout(
        self,
        library: &'static Library,
        element: Element,
        order: Order,
    ) -> Result<Layout, ModelError> {
        let dims = [1, self.channels, self.height, self.width];
        Layout::map(library, dims, element, order).map_err(failed("a map"))
    }

    pub(super) fn pixels(self) -> usize {
        self.height * self.width
    }
}

/// A map of one image in 32-bit floats.
#[derive(Debug)]
pub(super) struct Map {
    pub memory: Memory,
    pub shape: Shape,
    pub order: Order,
}

impl Map {
    /// A map with any values in it.
    pub(super) fn take(
        context: &mut Context,
        shape: Shape,
        order: Order,
    ) -> Result<Self, ModelError> {
        let layout = shape.layout(context.library(), Element::F32, order)?;
        Ok(Self { memory: context.take(layout), shape, order })
    }

    /// Values side by side of one pixel.
    pub(super) fn lanes(&self) -> usize {
        lanes(self.order, self.shape.channels)
    }

    pub(super) fn values(&self) -> &[f32] {
        self.memory.floats()
    }

    pub(super) fn values_mut(&mut self) -> &mut [f32] {
        self.memory.floats_mut()
    }

    /// In this order, `margin` pixels of zeros around.
    pub(super) fn of_grid(
        context: &mut Context,
        grid: &Grid,
        margin: usize,
        order: Order,
    ) -> Result<Self, ModelError> {
        let shape = Shape {
            channels: grid.channels,
            height: grid.height + 2 * margin,
            width: grid.width + 2 * margin,
        };
        let mut map = Self::take(context, shape, order)?;
        let lanes = map.lanes();
        map.values_mut().par_chunks_mut(shape.pixels() * lanes).enumerate().for_each(
            |(block, out)| {
                out.fill(0.0);
                for lane in 0..lanes {
                    let channel = grid.channel(block * lanes + lane);
                    for (row, values) in channel.chunks_exact(grid.width).enumerate() {
                        let first = ((row + margin) * shape.width + margin) * lanes + lane;
                        for (column, value) in values.iter().enumerate() {
                            out[first + column * lanes] = *value;
                        }
                    }
                }
            },
        );
        Ok(map)
    }

    /// Channel after channel.
    pub(super) fn to_grid(&self) -> Grid {
        let Shape { channels, height, width } = self.shape;
        let (pixels, lanes) = (self.shape.pixels(), self.lanes());
        let mut data = vec![0.0; channels * pixels];
        data.par_chunks_mut(pixels).enumerate().for_each(|(channel, out)| {
            let block = &self.values()[channel / lanes * pixels * lanes..][..pixels * lanes];
            let lane = channel % lanes;
            for (out, pixel) in out.iter_mut().zip(block.chunks_exact(lanes)) {
                *out = pixel[lane];
            }
        });
        Grid::new(channels, height, width, data)
    }
}

pub(super) fn lanes(order: Order, channels: usize) -> usize {
    match order {
        Order::Pixels => channels,
        Order::Blocks => BLOCK,
    }
}
