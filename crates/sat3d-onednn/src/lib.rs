//! A small safe wrapper over the C API of [oneDNN](https://github.com/uxlfoundation/oneDNN) 2.6: convolutions,
//! products of matrices and softmax on the processor, in 32-bit and 16-bit floats.
//!
//! The library is looked for when the program runs, so that one program serves machines with and without it. Every
//! memory is checked against the layout that an operation was compiled for before the library sees it.
//!
//! ```
//! use sat3d_onednn::{After, Element, Layout, Library, Memory, Product, Session, View};
//!
//! // A machine without the library says so, and what to install.
//! let library = match Library::get() {
//!     Ok(library) => library,
//!     Err(error) => return Ok(println!("{error}")),
//! };
//! let mut session = Session::new(library)?;
//! let matrix = Layout::dense(library, &[2, 2], Element::F32)?;
//! let product = Product::new(library, matrix, matrix, None, matrix, After::default())?;
//! let (left, right) = ([1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 1.0, 0.0]);
//! let mut result = Memory::new(matrix);
//! product.run(
//!     &mut session,
//!     View::of(matrix, &left)?,
//!     View::of(matrix, &right)?,
//!     &[],
//!     &mut result,
//! )?;
//! assert_eq!(result.floats(), [2.0, 1.0, 4.0, 3.0]);
//! # Ok::<(), sat3d_onednn::Error>(())
//! ```
#![allow(unsafe_code, reason = "a C library is called; every block says why it may be")]

mod error;
mod library;
mod memory;
mod primitive;
mod raw;

pub use error::{Error, LoadError};
pub use library::{Instructions, Library};
pub use memory::{Arena, BLOCK, Element, Layout, Memory, Order, View};
pub use primitive::{
    After, Algorithm, Convolution, ConvolutionSpec, Product, Session, Softmax, reorder,
};
