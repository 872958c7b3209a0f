//! The operations.

use crate::error::Error;
use crate::library::{Library, done};
use crate::memory::{Buffer, Element, Layout, Memory, Order, View};
use crate::raw::{self, Argument, Dims, Handle, MAX_AXES, MemoryDesc, OperationDesc};
use std::ffi::{CStr, c_char, c_int, c_void};

/// What operations are run with: a stream, and memory that they calculate in.
pub struct Session {
    library: &'static Library,
    stream: Handle,
    scratch: Buffer,
}

// SAFETY: a stream may be used from any thread, by one at a time, which `&mut self` sees to.
unsafe impl Send for Session {}

impl std::fmt::Debug for Session {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Session").field("scratch", &self.scratch).finish_non_exhaustive()
    }
}

impl Session {
    /// A new one.
    ///
    /// # Errors
    /// [`Error::Failed`].
    pub fn new(library: &'static Library) -> Result<Self, Error> {
        let mut stream: Handle = std::ptr::null_mut();
        // SAFETY: writes one handle.
        let status = unsafe {
            (library.call.stream_create)(
                &raw mut stream,
                library.engine,
                raw::DEFAULT_STREAM as u32,
            )
        };
        done(status, "a stream")?;
        Ok(Self { library, stream, scratch: Buffer::default() })
    }

    /// The library.
    #[must_use]
    pub fn library(&self) -> &'static Library {
        self.library
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // SAFETY: made by `new`, used by nobody any more.
        unsafe { (self.library.call.stream_destroy)(self.stream) };
    }
}

/// One of the library's objects that has to be destroyed.
struct Owned {
    handle: Handle,
    destroy: unsafe extern "C" fn(Handle) -> c_int,
}

impl Drop for Owned {
    fn drop(&mut self) {
        // SAFETY: the function belongs to the kind of object, which nobody else destroys.
        unsafe { (self.destroy)(self.handle) };
    }
}

/// A compiled operation.
struct Primitive {
    library: &'static Library,
    operation: &'static str,
    /// What the library calls its way of doing it, as `jit_wino_4x3:avx512_core`.
    name: String,
    primitive: Owned,
    scratch: Layout,
}

// SAFETY: a primitive may be executed from any thread; what it calculates in is the session's.
unsafe impl Send for Primitive {}
// SAFETY: as above.
unsafe impl Sync for Primitive {}

/// What follows an operation without another pass over its result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct After {
    /// Adds the result to what is in the destination already.
    pub sum: bool,
    /// x/2 (1 + erf(x / sqrt 2)).
    pub gelu: bool,
}

impl Primitive {
    fn new(
        library: &'static Library,
        operation: &'static str,
        desc: &OperationDesc,
        after: After,
    ) -> Result<(Self, Owned), Error> {
        let call = &library.call;
        let owned = |handle, destroy| Owned { handle, destroy };
        let mut handle: Handle = std::ptr::null_mut();
        // SAFETY: each call writes one handle, of which the next calls are given live ones.
        unsafe {
            done((call.attr_create)(&raw mut handle), operation)?;
            let attributes = owned(handle, call.attr_destroy);
            done((call.attr_scratch)(attributes.handle, raw::SCRATCH_OF_USER), operation)?;
            done((call.post_ops_create)(&raw mut handle), operation)?;
            let post = owned(handle, call.post_ops_destroy);
            if after.sum {
                done((call.post_ops_sum)(post.handle, 1.0), operation)?;
            }
            if after.gelu {
                let code = raw::GELU_ERF;
                done((call.post_ops_eltwise)(post.handle, 1.0, code, 0.0, 0.0), operation)?;
            }
            done((call.attr_post_ops)(attributes.handle, post.handle), operation)?;
            let status = (call.primitive_desc_create)(
                &raw mut handle,
                desc,
                attributes.handle,
                library.engine,
                std::ptr::null_mut(),
            );
            done(status, operation)?;
        }
        let desc = owned(handle, call.primitive_desc_destroy);
        Ok((Self::compile(library, operation, &desc)?, desc))
    }

    fn compile(
        library: &'static Library,
        operation: &'static str,
        desc: &Owned,
    ) -> Result<Self, Error> {
        let call = &library.call;
        let mut name: *const c_char = std::ptr::null();
        let mut handle: Handle = std::ptr::null_mut();
        // SAFETY: the query writes a pointer to a text that lives as long as the description.
        let name = unsafe {
            let place = (&raw mut name).cast::<c_void>();
            done((call.query)(desc.handle, raw::QUERY_NAME, 0, place), operation)?;
            CStr::from_ptr(name).to_string_lossy().into_owned()
        };
        // SAFETY: writes one handle.
        done(unsafe { (call.primitive_create)(&raw mut handle, desc.handle) }, operation)?;
        let primitive = Owned { handle, destroy: call.primitive_destroy };
        let scratch = layout(library, desc, raw::QUERY_SCRATCH);
        Ok(Self { library, operation, name, primitive, scratch })
    }

    /// Checks every memory against the layout that the operation was made for, and runs it.
    fn run(
        &self,
        session: &mut Session,
        inputs: &[(c_int, &'static str, View<'_>, &Layout)],
        (output, wanted): (&mut Memory, &Layout),
    ) -> Result<(), Error> {
        let wrong = |role| Error::Layout { operation: self.operation.into(), role };
        for (_, role, view, wanted) in inputs {
            if view.layout != **wanted {
                return Err(wrong(role));
            }
        }
        if output.layout() != wanted {
            return Err(wrong("result"));
        }
        let bytes = self.scratch.bytes();
        if session.scratch.bytes() < bytes {
            // The old one goes first.
            session.scratch = Buffer::default();
            session.scratch = Buffer::new(bytes);
        }
        let mut memories = Vec::with_capacity(inputs.len() + 2);
        let mut arguments = Vec::with_capacity(inputs.len() + 2);
        let mut add = |role: c_int, layout: &Layout, pointer: *mut u8| {
            let call = &self.library.call;
            let mut memory: Handle = std::ptr::null_mut();
            // SAFETY: the pointer has as many bytes as the layout asks for: those of a memory or a view always
            // have, and the scratch memory was just made so large.
            let status = unsafe {
                let engine = self.library.engine;
                (call.memory_create)(
                    &raw mut memory,
                    &raw const layout.desc,
                    engine,
                    pointer.cast(),
                )
            };
            done(status, self.operation)?;
            memories.push(Owned { handle: memory, destroy: call.memory_destroy });
            arguments.push(Argument { role, memory });
            Ok::<_, Error>(())
        };
        for (role, _, view, _) in inputs {
            // The library reads inputs only.
            add(*role, &view.layout, view.pointer.cast_mut())?;
        }
        let layout = *output.layout();
        add(raw::DST, &layout, output.pointer())?;
        add(raw::SCRATCH, &self.scratch, session.scratch.pointer())?;
        // SAFETY: primitive and memories live; inputs, output and scratch memory do not overlap, since the output
        // is borrowed alone.
        unsafe {
            let count = arguments.len() as c_int;
            let status = (self.library.call.execute)(
                self.primitive.handle,
                session.stream,
                count,
                arguments.as_ptr(),
            );
            done(status, self.operation)?;
            done((self.library.call.stream_wait)(session.stream), self.operation)
        }
    }
}

/// One of the layouts that a description settled on.
fn layout(library: &'static Library, desc: &Owned, which: c_int) -> Layout {
    // SAFETY: the result is null or a description that lives as long as `desc`; it is copied.
    let found = unsafe { (library.call.query_md)(desc.handle, which, 0).as_ref().copied() };
    Layout::from_library(library, found.unwrap_or(MemoryDesc([0; 87])))
}

/// Copies into another layout, type or order.
///
/// # Errors
/// [`Error::Unimplemented`] where the library knows no way; [`Error::Failed`].
pub fn reorder(session: &mut Session, from: View<'_>, to: &mut Memory) -> Result<(), Error> {
    const NAME: &str = "a change of layout";
    let library = session.library;
    let call = &library.call;
    let mut handle: Handle = std::ptr::null_mut();
    let wanted = *to.layout();
    // SAFETY: writes one handle; attributes may be null.
    let status = unsafe {
        (call.reorder_desc_create)(
            &raw mut handle,
            &raw const from.layout.desc,
            library.engine,
            &raw const wanted.desc,
            library.engine,
            std::ptr::null_mut(),
        )
    };
    done(status, NAME)?;
    let desc = Owned { handle, destroy: call.primitive_desc_destroy };
    let primitive = Primitive::compile(library, NAME, &desc)?;
    let layout = from.layout;
    primitive.run(session, &[(raw::SRC, "source", from, &layout)], (to, &wanted))
}

/// How a convolution is calculated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Algorithm {
    /// As it is written.
    Direct,
    /// Winograd's, with fewer multiplications and a little less exact.
    Winograd,
}

/// A convolution with stride 1 to be made.
#[derive(Clone, Copy, Debug)]
pub struct ConvolutionSpec {
    /// Images.
    pub batch: usize,
    /// Channels in.
    pub inputs: usize,
    /// Channels out.
    pub outputs: usize,
    /// Height and width of the input.
    pub size: [usize; 2],
    /// Height and width of the kernel.
    pub kernel: [usize; 2],
    /// Zeros above and left.
    pub before: [usize; 2],
    /// Zeros below and right.
    pub after: [usize; 2],
    /// Type of input and weights; the result is always in 32 bits.
    pub element: Element,
    /// Order of input and result.
    pub order: Order,
    /// How.
    pub algorithm: Algorithm,
    /// Whether the result is added to what is there.
    pub sum: bool,
}

/// A convolution.
pub struct Convolution {
    primitive: Primitive,
    source: Layout,
    weights: Layout,
    bias: Layout,
    result: Layout,
    plain: Layout,
}

impl std::fmt::Debug for Convolution {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "Convolution({})", self.primitive.name)
    }
}

impl Convolution {
    /// Compiles it.
    ///
    /// # Errors
    /// [`Error::Unimplemented`] where this processor has no such convolution.
    pub fn new(library: &'static Library, spec: &ConvolutionSpec) -> Result<Self, Error> {
        const NAME: &str = "convolution";
        let ConvolutionSpec { batch, inputs, outputs, size, kernel, element, order, .. } = *spec;
        let across =
            |axis: usize| size[axis] + spec.before[axis] + spec.after[axis] + 1 - kernel[axis];
        let source = Layout::map(library, [batch, inputs, size[0], size[1]], element, order)?;
        let result = [batch, outputs, across(0), across(1)];
        let result = Layout::map(library, result, Element::F32, order)?;
        let shape = [outputs, inputs, kernel[0], kernel[1]];
        let weights = Layout::any(library, &shape, element)?;
        let bias = Layout::dense(library, &[outputs], Element::F32)?;
        let plain = Layout::tagged(library, &shape, Element::F32, raw::TAG_PLAIN_4)?;
        let algorithm = match spec.algorithm {
            Algorithm::Direct => raw::DIRECT,
            Algorithm::Winograd => raw::WINOGRAD,
        };
        let axes = |values: [usize; 2]| -> Dims {
            let mut dims = [0; MAX_AXES];
            dims[0] = values[0] as i64;
            dims[1] = values[1] as i64;
            dims
        };
        let mut desc = OperationDesc([0; 1024]);
        // SAFETY: `desc` is larger than the library's; all layouts live.
        let status = unsafe {
            (library.call.convolution_desc)(
                &raw mut desc,
                raw::FORWARD_INFERENCE,
                algorithm,
                &raw const source.desc,
                &raw const weights.desc,
                &raw const bias.desc,
                &raw const result.desc,
                axes([1, 1]).as_ptr(),
                axes(spec.before).as_ptr(),
                axes(spec.after).as_ptr(),
            )
        };
        done(status, NAME)?;
        let after = After { sum: spec.sum, gelu: false };
        let (primitive, desc) = Primitive::new(library, NAME, &desc, after)?;
        Ok(Self {
            source: layout(library, &desc, raw::QUERY_SRC),
            weights: layout(library, &desc, raw::QUERY_WEIGHTS),
            result: layout(library, &desc, raw::QUERY_DST),
            primitive,
            bias,
            plain,
        })
    }

    /// The library's name of how it is done.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.primitive.name
    }

    /// Layout of the input.
    #[must_use]
    pub fn source(&self) -> Layout {
        self.source
    }

    /// Layout of the result.
    #[must_use]
    pub fn result(&self) -> Layout {
        self.result
    }

    /// Layout of the weights as this convolution wants them.
    #[must_use]
    pub fn weights(&self) -> Layout {
        self.weights
    }

    /// Weights (`outputs x inputs x height x width`) as this convolution wants them.
    ///
    /// # Errors
    /// [`Error::Length`]; those of [`reorder`].
    pub fn pack(&self, session: &mut Session, weights: &[f32]) -> Result<Memory, Error> {
        let mut packed = Memory::new(self.weights);
        reorder(session, View::of(self.plain, weights)?, &mut packed)?;
        Ok(packed)
    }

    /// Convolves.
    ///
    /// # Errors
    /// [`Error::Layout`] for a memory that is not of this convolution's layout.
    pub fn run(
        &self,
        session: &mut Session,
        source: View<'_>,
        weights: &Memory,
        bias: &[f32],
        result: &mut Memory,
    ) -> Result<(), Error> {
        let bias = View::of(self.bias, bias)?;
        let inputs = [
            (raw::SRC, "input", source, &self.source),
            (raw::WEIGHTS, "weights", weights.view(), &self.weights),
            (raw::BIAS, "bias", bias, &self.bias),
        ];
        self.primitive.run(session, &inputs, (result, &self.result))
    }
}

/// A product of matrices, or of stacks of them.
pub struct Product {
    primitive: Primitive,
    left: Layout,
    right: Layout,
    bias: Option<Layout>,
    result: Layout,
}

impl std::fmt::Debug for Product {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "Product({})", self.primitive.name)
    }
}

impl Product {
    /// Compiles `left x right` (+ one bias of `bias` values for every row).
    ///
    /// # Errors
    /// [`Error::Unimplemented`] where this processor has none for these layouts.
    pub fn new(
        library: &'static Library,
        left: Layout,
        right: Layout,
        bias: Option<usize>,
        result: Layout,
        after: After,
    ) -> Result<Self, Error> {
        const NAME: &str = "product of matrices";
        let bias =
            bias.map(|width| Layout::dense(library, &[1, width], Element::F32)).transpose()?;
        let mut desc = OperationDesc([0; 1024]);
        let none = MemoryDesc([0; 87]);
        let biased = bias.as_ref().map_or(&none, |layout| &layout.desc);
        // SAFETY: as for a convolution; a description of zeros stands for no bias.
        let status = unsafe {
            (library.call.matmul_desc)(
                &raw mut desc,
                &raw const left.desc,
                &raw const right.desc,
                biased,
                &raw const result.desc,
            )
        };
        done(status, NAME)?;
        let (primitive, desc) = Primitive::new(library, NAME, &desc, after)?;
        Ok(Self {
            right: layout(library, &desc, raw::QUERY_WEIGHTS),
            primitive,
            left,
            bias,
            result,
        })
    }

    /// As [`Product::new`], where the right side is constant and may be laid out as the product likes it best:
    /// `rows x columns`, to be made by [`Product::pack`].
    ///
    /// # Errors
    /// As [`Product::new`].
    pub fn packed(
        library: &'static Library,
        left: Layout,
        (rows, columns, element): (usize, usize, Element),
        result: Layout,
        after: After,
    ) -> Result<Self, Error> {
        let right = Layout::any(library, &[rows, columns], element)?;
        Self::new(library, left, right, Some(columns), result, after)
    }

    /// The library's name of how it is done.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.primitive.name
    }

    /// The right side as this product wants it.
    ///
    /// # Errors
    /// Those of [`reorder`].
    pub fn pack(&self, session: &mut Session, right: View<'_>) -> Result<Memory, Error> {
        let mut packed = Memory::new(self.right);
        reorder(session, right, &mut packed)?;
        Ok(packed)
    }

    /// Multiplies. The bias is there or not as the product was made.
    ///
    /// # Errors
    /// [`Error::Layout`] for a memory that is not of this product's layout; [`Error::Length`] for another bias.
    pub fn run(
        &self,
        session: &mut Session,
        left: View<'_>,
        right: View<'_>,
        bias: &[f32],
        result: &mut Memory,
    ) -> Result<(), Error> {
        let mut inputs = vec![
            (raw::SRC, "left side", left, &self.left),
            (raw::WEIGHTS, "right side", right, &self.right),
        ];
        match &self.bias {
            Some(layout) => inputs.push((raw::BIAS, "bias", View::of(*layout, bias)?, layout)),
            None if bias.is_empty() => {}
            None => return Err(Error::Length { found: bias.len(), expected: 0 }),
        }
        self.primitive.run(session, &inputs, (result, &self.result))
    }
}

/// Exponentials of rows, each divided by their sum.
pub struct Softmax {
    primitive: Primitive,
    layout: Layout,
}

impl std::fmt::Debug for Softmax {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "Softmax({})", self.primitive.name)
    }
}

impl Softmax {
    /// Compiles it, along the last of `axes` axes.
    ///
    /// # Errors
    /// [`Error::Unimplemented`].
    pub fn new(library: &'static Library, values: Layout, axes: usize) -> Result<Self, Error> {
        const NAME: &str = "softmax";
        let mut desc = OperationDesc([0; 1024]);
        let last = axes as c_int - 1;
        // SAFETY: as for a convolution.
        let status = unsafe {
            let kind = raw::FORWARD_INFERENCE;
            (library.call.softmax_desc)(&raw mut desc, kind, &raw const values.desc, last)
        };
        done(status, NAME)?;
        let (primitive, _) = Primitive::new(library, NAME, &desc, After::default())?;
        Ok(Self { primitive, layout: values })
    }

    /// From one memory into another.
    ///
    /// # Errors
    /// [`Error::Layout`].
    pub fn run(&self, session: &mut Session, from: View<'_>, to: &mut Memory) -> Result<(), Error> {
        let inputs = [(raw::SRC, "input", from, &self.layout)];
        self.primitive.run(session, &inputs, (to, &self.layout))
    }
}
