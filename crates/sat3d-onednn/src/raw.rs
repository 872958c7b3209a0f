//! The C interface: types, numbers and functions of `dnnl.h` and `dnnl_types.h`, version 2.6.

use std::ffi::{c_char, c_int, c_void};

/// Largest number of axes (`DNNL_MAX_NDIMS`).
pub(crate) const MAX_AXES: usize = 12;
/// Success, of a `dnnl_status_t`.
pub(crate) const SUCCESS: c_int = 0;
pub(crate) const UNIMPLEMENTED: c_int = 3;

pub(crate) const CPU: c_int = 1;
pub(crate) const DEFAULT_STREAM: c_int = 1;
pub(crate) const F32: c_int = 3;
pub(crate) const BF16: c_int = 2;
pub(crate) const TAG_ANY: c_int = 1;
/// Channels innermost: `nhwc`.
pub(crate) const TAG_PIXELS: c_int = 20;
/// Blocks of 16 channels innermost: `aBcd16b`.
pub(crate) const TAG_BLOCKS: c_int = 69;
/// Row-major convolution weights: `oihw`.
pub(crate) const TAG_PLAIN_4: c_int = 5;
pub(crate) const FORWARD_INFERENCE: c_int = 96;
pub(crate) const DIRECT: c_int = 1;
pub(crate) const WINOGRAD: c_int = 2;
pub(crate) const GELU_ERF: c_int = 48;
pub(crate) const SCRATCH_OF_USER: c_int = 1;

pub(crate) const QUERY_NAME: c_int = 8;
pub(crate) const QUERY_SRC: c_int = 129;
pub(crate) const QUERY_WEIGHTS: c_int = 131;
pub(crate) const QUERY_DST: c_int = 133;
pub(crate) const QUERY_SCRATCH: c_int = 136;

pub(crate) const SRC: c_int = 1;
pub(crate) const DST: c_int = 17;
pub(crate) const WEIGHTS: c_int = 33;
pub(crate) const BIAS: c_int = 41;
pub(crate) const SCRATCH: c_int = 80;

/// `dnnl_memory_desc_t`: 696 bytes, made and read by the library alone.
#[derive(Clone, Copy)]
#[repr(C, align(8))]
pub(crate) struct MemoryDesc(pub [u64; 87]);

/// Any description of an operation; the largest here, of a convolution, has 5976 bytes.
#[repr(C, align(8))]
pub(crate) struct OperationDesc(pub [u64; 1024]);

/// `dnnl_version_t`.
#[repr(C)]
pub(crate) struct Version {
    pub major: c_int,
    pub minor: c_int,
    pub patch: c_int,
    pub hash: *const c_char,
    pub cpu_runtime: u32,
    pub gpu_runtime: u32,
}

/// `dnnl_exec_arg_t`.
#[repr(C)]
pub(crate) struct Argument {
    pub role: c_int,
    pub memory: Handle,
}

/// Any of the library's objects.
pub(crate) type Handle = *mut c_void;
pub(crate) type Dims = [i64; MAX_AXES];
type Status = c_int;

/// Declares the table of functions and how it is filled from an open library.
macro_rules! functions {
    ($($name:ident = $symbol:literal: fn($($argument:ty),* $(,)?) $(-> $result:ty)?;)*) => {
        /// The functions that are called, by their names in the library.
        pub(crate) struct Functions {
            $(pub $name: unsafe extern "C" fn($($argument),*) $(-> $result)?,)*
        }

        impl Functions {
            /// Looks all of them up.
            ///
            /// # Safety
            /// The library has to be oneDNN, of a version whose header declares them so.
            pub(crate) unsafe fn of(library: &libloading::Library) -> Result<Self, libloading::Error> {
                // SAFETY: the types are those of the header, by the caller's promise about the version.
                unsafe { Ok(Self { $($name: *library.get(concat!($symbol, "\0"))?,)* }) }
            }
        }
    };
}

functions! {
    engine_create = "dnnl_engine_create": fn(*mut Handle, c_int, usize) -> Status;
    stream_create = "dnnl_stream_create": fn(*mut Handle, Handle, u32) -> Status;
    stream_wait = "dnnl_stream_wait": fn(Handle) -> Status;
    stream_destroy = "dnnl_stream_destroy": fn(Handle) -> Status;
    effective_isa = "dnnl_get_effective_cpu_isa": fn() -> c_int;
    desc_by_tag = "dnnl_memory_desc_init_by_tag": fn(*mut MemoryDesc, c_int, *const i64, c_int, c_int) -> Status;
    desc_by_strides = "dnnl_memory_desc_init_by_strides":
        fn(*mut MemoryDesc, c_int, *const i64, c_int, *const i64) -> Status;
    desc_size = "dnnl_memory_desc_get_size": fn(*const MemoryDesc) -> usize;
    desc_equal = "dnnl_memory_desc_equal": fn(*const MemoryDesc, *const MemoryDesc) -> c_int;
    memory_create = "dnnl_memory_create": fn(*mut Handle, *const MemoryDesc, Handle, *mut c_void) -> Status;
    memory_destroy = "dnnl_memory_destroy": fn(Handle) -> Status;
    attr_create = "dnnl_primitive_attr_create": fn(*mut Handle) -> Status;
    attr_destroy = "dnnl_primitive_attr_destroy": fn(Handle) -> Status;
    attr_scratch = "dnnl_primitive_attr_set_scratchpad_mode": fn(Handle, c_int) -> Status;
    attr_post_ops = "dnnl_primitive_attr_set_post_ops": fn(Handle, Handle) -> Status;
    post_ops_create = "dnnl_post_ops_create": fn(*mut Handle) -> Status;
    post_ops_destroy = "dnnl_post_ops_destroy": fn(Handle) -> Status;
    post_ops_sum = "dnnl_post_ops_append_sum": fn(Handle, f32) -> Status;
    post_ops_eltwise = "dnnl_post_ops_append_eltwise": fn(Handle, f32, c_int, f32, f32) -> Status;
    convolution_desc = "dnnl_convolution_forward_desc_init":
        fn(*mut OperationDesc, c_int, c_int, *const MemoryDesc, *const MemoryDesc, *const MemoryDesc,
           *const MemoryDesc, *const i64, *const i64, *const i64) -> Status;
    matmul_desc = "dnnl_matmul_desc_init":
        fn(*mut OperationDesc, *const MemoryDesc, *const MemoryDesc, *const MemoryDesc, *const MemoryDesc) -> Status;
    softmax_desc = "dnnl_softmax_forward_desc_init":
        fn(*mut OperationDesc, c_int, *const MemoryDesc, c_int) -> Status;
    primitive_desc_create = "dnnl_primitive_desc_create":
        fn(*mut Handle, *const OperationDesc, Handle, Handle, Handle) -> Status;
    reorder_desc_create = "dnnl_reorder_primitive_desc_create":
        fn(*mut Handle, *const MemoryDesc, Handle, *const MemoryDesc, Handle, Handle) -> Status;
    primitive_desc_destroy = "dnnl_primitive_desc_destroy": fn(Handle) -> Status;
    query = "dnnl_primitive_desc_query": fn(Handle, c_int, c_int, *mut c_void) -> Status;
    query_md = "dnnl_primitive_desc_query_md": fn(Handle, c_int, c_int) -> *const MemoryDesc;
    primitive_create = "dnnl_primitive_create": fn(*mut Handle, Handle) -> Status;
    primitive_destroy = "dnnl_primitive_destroy": fn(Handle) -> Status;
    execute = "dnnl_primitive_execute": fn(Handle, Handle, c_int, *const Argument) -> Status;
}
