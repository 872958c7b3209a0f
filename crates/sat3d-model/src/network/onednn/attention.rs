//! Products of queries, keys and values, for one head or several.

use super::map::{Context, failed};
use crate::error::ModelError;
use sat3d_onednn::{After, Element, Error, Layout, Library, Memory, Product, Softmax, View};

/// Attention of `heads` heads of `size` channels over `rows` places, in 32-bit floats. A head's queries, keys and values
/// are columns of rows of `stride` values.
#[derive(Debug)]
pub(super) struct Heads {
    query: Layout,
    key: Layout,
    value: Layout,
    logits: Product,
    shares: Softmax,
    mix: Product,
    square: Layout,
    mixed: Layout,
    rows: Layout,
}

impl Heads {
    pub(super) fn new(
        library: &'static Library,
        rows: usize,
        (heads, size): (usize, usize),
        stride: usize,
    ) -> Result<Self, ModelError> {
        let make = || {
            let f32 = Element::F32;
            let none = After::default();
            let width = heads * size;
            let strided = |dims: [usize; 3], strides: [usize; 3]| {
                Layout::strided(library, &dims, f32, &strides)
            };
            let query = strided([heads, rows, size], [size, stride, 1])?;
            let key = strided([heads, size, rows], [size, 1, stride])?;
            let value = strided([heads, rows, size], [size, stride, 1])?;
            let mixed = strided([heads, rows, size], [size, width, 1])?;
            let square = Layout::dense(library, &[heads, rows, rows], f32)?;
            Ok::<_, Error>(Self {
                query,
                key,
                value,
                logits: Product::new(library, query, key, None, square, none)?,
                shares: Softmax::new(library, square, 3)?,
                mix: Product::new(library, square, value, None, mixed, none)?,
                square,
                mixed,
                rows: Layout::dense(library, &[rows, width], f32)?,
            })
        };
        make().map_err(failed("attention"))
    }

    /// Rows of all heads' channels side by side. Each part is the values and where its first stands in them; queries are
    /// scaled already.
    pub(super) fn forward(
        &self,
        context: &mut Context,
        [query, key, value]: [(&[f32], usize); 3],
    ) -> Result<Memory, ModelError> {
        let mut logits = context.take(self.square);
        let mut shares = context.take(self.square);
        let mixed = context.take(self.rows);
        let session = &mut context.session;
        let run = || {
            let view = |layout, (values, first)| View::part(layout, values, first);
            let (query, key) = (view(self.query, query)?, view(self.key, key)?);
            self.logits.run(session, query, key, &[], &mut logits)?;
            self.shares.run(session, logits.view(), &mut shares)?;
            let mut mixed = mixed.relaid(self.mixed)?;
            self.mix.run(session, shares.view(), view(self.value, value)?, &[], &mut mixed)?;
            mixed.relaid(self.rows)
        };
        let mixed = run().map_err(failed("attention"))?;
        context.put(logits);
        context.put(shares);
        Ok(mixed)
    }
}
