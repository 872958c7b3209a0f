//! Memory and how it is laid out.

use crate::error::Error;
use crate::library::{Library, done};
use crate::raw::{self, Dims, MAX_AXES, MemoryDesc};
use std::ffi::c_int;
use std::marker::PhantomData;

/// Type of the values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    F32,
    /// The upper halves of 32-bit floats.
    Bf16,
}

impl Element {
    pub(crate) fn code(self) -> c_int {
        match self {
            Self::F32 => raw::F32,
            Self::Bf16 => raw::BF16,
        }
    }
}

/// Channels of a block of [`Order::Blocks`].
pub const BLOCK: usize = 16;

/// Order of a map's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// All channels of a pixel side by side.
    Pixels,
    /// Sixteen channels of a pixel side by side; the next sixteen in another map of the same size.
    Blocks,
}

/// Shape, type and order of a memory.
#[derive(Clone, Copy)]
pub struct Layout {
    pub(crate) library: &'static Library,
    pub(crate) desc: MemoryDesc,
    /// Values from the first to the last, where strides say so.
    span: Option<usize>,
}

impl std::fmt::Debug for Layout {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "Layout({} bytes)", self.bytes())
    }
}

impl PartialEq for Layout {
    fn eq(&self, other: &Self) -> bool {
        // SAFETY: both were made by the library.
        unsafe { (self.library.call.desc_equal)(&raw const self.desc, &raw const other.desc) != 0 }
    }
}

impl Layout {
    /// A map of a batch of images: `[batch, channels, height, width]`.
    ///
    /// # Errors
    /// [`Error::Failed`] where the library refuses the sizes.
    pub fn map(
        library: &'static Library,
        dims: [usize; 4],
        element: Element,
        order: Order,
    ) -> Result<Self, Error> {
        let tag = match order {
            Order::Pixels => raw::TAG_PIXELS,
            // The rest of a block would have to be zeros, which nobody sees to.
            Order::Blocks if !dims[1].is_multiple_of(BLOCK) => {
                let operation = format!("blocks of {BLOCK} for {} channels", dims[1]);
                return Err(Error::Unimplemented { operation });
            }
            Order::Blocks => raw::TAG_BLOCKS,
        };
        Self::tagged(library, &dims, element, tag)
    }

    /// A matrix or a stack of them, with the distance in values from one to the next along each axis.
    ///
    /// # Errors
    /// As [`Layout::map`].
    pub fn strided(
        library: &'static Library,
        dims: &[usize],
        element: Element,
        strides: &[usize],
    ) -> Result<Self, Error> {
        let mut desc = MemoryDesc([0; 87]);
        let (sizes, steps) = (padded(dims), padded(strides));
        // SAFETY: `desc` is as large as the library's, and the axes are at most 12, as the arrays are long.
        let status = unsafe {
            (library.call.desc_by_strides)(
                &raw mut desc,
                dims.len().min(MAX_AXES) as c_int,
                sizes.as_ptr(),
                element.code(),
                steps.as_ptr(),
            )
        };
        done(status, "a layout")?;
        let reach = |(dim, stride): (&usize, &usize)| dim.saturating_sub(1).saturating_mul(*stride);
        let span = dims.iter().zip(strides).map(reach).fold(1, usize::saturating_add);
        Ok(Self { library, desc, span: Some(span) })
    }

    /// The same, row-major.
    ///
    /// # Errors
    /// As [`Layout::map`].
    pub fn dense(
        library: &'static Library,
        dims: &[usize],
        element: Element,
    ) -> Result<Self, Error> {
        let strides: Vec<usize> =
            (0..dims.len()).map(|axis| dims[axis + 1..].iter().product()).collect();
        Self::strided(library, dims, element, &strides)
    }

    /// As the operation likes it best.
    pub(crate) fn any(
        library: &'static Library,
        dims: &[usize],
        element: Element,
    ) -> Result<Self, Error> {
        Self::tagged(library, dims, element, raw::TAG_ANY)
    }

    pub(crate) fn tagged(
        library: &'static Library,
        dims: &[usize],
        element: Element,
        tag: c_int,
    ) -> Result<Self, Error> {
        let mut desc = MemoryDesc([0; 87]);
        let sizes = padded(dims);
        // SAFETY: as in `strided`.
        let status = unsafe {
            (library.call.desc_by_tag)(
                &raw mut desc,
                dims.len().min(MAX_AXES) as c_int,
                sizes.as_ptr(),
                element.code(),
                tag,
            )
        };
        done(status, "a layout")?;
        Ok(Self::from_library(library, desc))
    }

    /// One that the library chose.
    pub(crate) fn from_library(library: &'static Library, desc: MemoryDesc) -> Self {
        Self { library, desc, span: None }
    }

    /// The library that made it.
    #[must_use]
    pub fn library(&self) -> &'static Library {
        self.library
    }

    /// What tells this layout from others, of this library's version: the library's own description.
    #[must_use]
    pub fn fingerprint(&self) -> Vec<u8> {
        let (major, minor, patch) = self.library.version();
        let version = [major, minor, patch].map(i64::from);
        let words = version.into_iter().chain(self.desc.0.iter().map(|word| *word as i64));
        words.flat_map(i64::to_le_bytes).collect()
    }

    /// Bytes that a memory of this layout takes, gaps included.
    #[must_use]
    pub fn bytes(&self) -> usize {
        // SAFETY: the description was made by the library.
        unsafe { (self.library.call.desc_size)(&raw const self.desc) }
    }
}

fn padded(values: &[usize]) -> Dims {
    let mut dims = [0; MAX_AXES];
    for (dim, value) in dims.iter_mut().zip(values) {
        *dim = i64::try_from(*value).unwrap_or(i64::MAX);
    }
    dims
}

/// One cache line, so that memory begins at one.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([u8; LINE]);

const LINE: usize = 64;

/// Bytes that begin at a cache line.
#[derive(Default)]
pub(crate) struct Buffer(Vec<Line>);

impl Buffer {
    pub(crate) fn new(bytes: usize) -> Self {
        Self(vec![Line([0; LINE]); bytes.div_ceil(LINE)])
    }

    pub(crate) fn bytes(&self) -> usize {
        self.0.len() * LINE
    }

    pub(crate) fn pointer(&mut self) -> *mut u8 {
        self.0.as_mut_ptr().cast()
    }
}

/// Values of one layout.
pub struct Memory {
    layout: Layout,
    bytes: usize,
    buffer: Buffer,
}

impl std::fmt::Debug for Memory {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "Memory({} bytes)", self.bytes)
    }
}

impl Memory {
    /// Zeros.
    #[must_use]
    pub fn new(layout: Layout) -> Self {
        let bytes = layout.bytes();
        Self { layout, bytes, buffer: Buffer::new(bytes) }
    }

    /// How it is laid out.
    #[must_use]
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The same memory, understood in another layout of 32-bit floats.
    ///
    /// # Errors
    /// [`Error::Length`] where that would reach beyond it.
    pub fn relaid(self, layout: Layout) -> Result<Self, Error> {
        let expected = layout.span.unwrap_or_else(|| layout.bytes() / 4);
        let found = self.buffer.bytes() / 4;
        if expected > found {
            return Err(Error::Length { found, expected });
        }
        Ok(Self { layout, bytes: self.bytes, buffer: self.buffer })
    }

    /// To be read by an operation.
    #[must_use]
    pub fn view(&self) -> View<'_> {
        View { layout: self.layout, pointer: self.buffer.0.as_ptr().cast(), life: PhantomData }
    }

    /// All of it as 32-bit floats, in the order of the layout. Of 16-bit values, two in each.
    #[must_use]
    pub fn floats(&self) -> &[f32] {
        // SAFETY: the buffer is initialised, has at least so many bytes, and any bits are a float.
        unsafe { std::slice::from_raw_parts(self.buffer.0.as_ptr().cast(), self.bytes / 4) }
    }

    /// The same, to be written.
    pub fn floats_mut(&mut self) -> &mut [f32] {
        // SAFETY: as above, and borrowed alone.
        unsafe { std::slice::from_raw_parts_mut(self.buffer.pointer().cast(), self.bytes / 4) }
    }

    /// All of it as the bits of 16-bit floats.
    #[must_use]
    pub fn halves(&self) -> &[u16] {
        // SAFETY: as above.
        unsafe { std::slice::from_raw_parts(self.buffer.0.as_ptr().cast(), self.bytes / 2) }
    }

    /// The same, to be written.
    pub fn halves_mut(&mut self) -> &mut [u16] {
        // SAFETY: as above.
        unsafe { std::slice::from_raw_parts_mut(self.buffer.pointer().cast(), self.bytes / 2) }
    }

    pub(crate) fn pointer(&mut self) -> *mut u8 {
        self.buffer.pointer()
    }
}

/// Values that somebody else keeps.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    pub(crate) layout: Layout,
    pub(crate) pointer: *const u8,
    life: PhantomData<&'a [u8]>,
}

impl<'a> View<'a> {
    /// Floats in the order of a layout of 32-bit floats.
    ///
    /// # Errors
    /// [`Error::Length`] for more or fewer values than the layout takes.
    pub fn of(layout: Layout, values: &'a [f32]) -> Result<Self, Error> {
        if layout.bytes() != size_of_val(values) {
            return Err(Error::Length { found: values.len(), expected: layout.bytes() / 4 });
        }
        Ok(Self { layout, pointer: values.as_ptr().cast(), life: PhantomData })
    }

    /// Part of a larger matrix of floats: the layout's first value is `values[first]`.
    ///
    /// # Errors
    /// [`Error::Length`] where the layout would reach beyond the values.
    pub fn part(layout: Layout, values: &'a [f32], first: usize) -> Result<Self, Error> {
        let rest = values.get(first..).unwrap_or_default();
        let expected = layout.span.unwrap_or_else(|| layout.bytes() / 4);
        if expected > rest.len() {
            return Err(Error::Length { found: rest.len(), expected });
        }
        Ok(Self { layout, pointer: rest.as_ptr().cast(), life: PhantomData })
    }
}

/// Memories that were used and can be used again.
#[derive(Debug, Default)]
pub struct Arena {
    free: Vec<Buffer>,
}

impl std::fmt::Debug for Buffer {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "Buffer({} bytes)", self.bytes())
    }
}

impl Arena {
    /// A memory with any values in it.
    pub fn take(&mut self, layout: Layout) -> Memory {
        let bytes = layout.bytes();
        // The smallest that is large enough.
        let fitting = (0..self.free.len())
            .filter(|&index| self.free[index].bytes() >= bytes)
            .min_by_key(|&index| self.free[index].bytes());
        let buffer = match fitting {
            Some(index) => self.free.swap_remove(index),
            None => Buffer::new(bytes),
        };
        Memory { layout, bytes, buffer }
    }

    /// Gives a memory back.
    pub fn put(&mut self, memory: Memory) {
        self.free.push(memory.buffer);
    }
}
