//! PROJ's C interface, and nothing else: the only unsafe code for coordinates.
//!
//! A PROJ context and the objects made in it belong to one thread at a time. [`Context`] and
//! [`Object`] stay on theirs; a [`Transform`] owns both and may move between threads, never be
//! shared by two.
#![expect(unsafe_code, reason = "calls PROJ's C interface")]

use super::CrsError;
use crate::grid::Projected;
use proj_sys as ffi;
use std::ffi::{CStr, CString, c_char, c_int};
use std::ptr::NonNull;
use std::rc::Rc;

/// A PROJ context. Silent: errors are returned, not logged.
#[derive(Debug)]
pub(super) struct Context(NonNull<ffi::PJ_CONTEXT>);

impl Context {
    /// A fresh context; `network` lets PROJ fetch grids.
    pub(super) fn new(network: bool) -> Result<Rc<Self>, CrsError> {
        // SAFETY: has no preconditions; the result is checked.
        let context = NonNull::new(unsafe { ffi::proj_context_create() })
            .ok_or_else(|| failed("create a context", "out of memory"))?;
        // SAFETY: the context is alive and owned here.
        unsafe {
            ffi::proj_log_level(context.as_ptr(), ffi::PJ_LOG_LEVEL_PJ_LOG_NONE);
            ffi::proj_context_set_enable_network(context.as_ptr(), c_int::from(network));
        }
        Ok(Rc::new(Self(context)))
    }

    /// PROJ's message for its latest error.
    fn message(&self) -> String {
        // SAFETY: the context is alive; the string belongs to it until its next call and is copied.
        unsafe {
            let code = ffi::proj_context_errno(self.0.as_ptr());
            text(ffi::proj_context_errno_string(self.0.as_ptr(), code))
        }
        .unwrap_or_else(|| "unknown error".to_owned())
    }

    /// An object from whatever PROJ understands: `EPSG:2927`, WKT, a pipeline.
    pub(super) fn create(self: &Rc<Self>, definition: &str) -> Result<Object, CrsError> {
        let short: String = definition.chars().take(80).collect();
        let action = format!("understand `{short}`");
        let c_definition = CString::new(definition).map_err(|_| failed(&action, "a NUL byte"))?;
        // SAFETY: context alive, string terminated; PROJ copies what it keeps.
        let object = unsafe { ffi::proj_create(self.0.as_ptr(), c_definition.as_ptr()) };
        self.own(object, &action)
    }

    /// The coordinate operation of an EPSG code.
    pub(super) fn operation(self: &Rc<Self>, code: u32) -> Result<Object, CrsError> {
        let c_code = CString::new(code.to_string()).map_err(|_| failed("read a code", "NUL"))?;
        // SAFETY: as in `create`; no options are given.
        let object = unsafe {
            ffi::proj_create_from_database(
                self.0.as_ptr(),
                c"EPSG".as_ptr(),
                c_code.as_ptr(),
                ffi::PJ_CATEGORY_PJ_CATEGORY_COORDINATE_OPERATION,
                0,
                std::ptr::null(),
            )
        };
        self.own(object, &format!("find the operation EPSG:{code}"))
    }

    /// All operations between two CRSs, in PROJ's order of preference. `area` is west, south, east,
    /// north in degrees. Operations whose grids are missing are listed after the others.
    pub(super) fn operations(
        self: &Rc<Self>,
        source: &Object,
        target: &Object,
        area: Option<[f64; 4]>,
        network: bool,
    ) -> Result<Vec<Object>, CrsError> {
        let action = "list the operations between two CRSs";
        let availability = if network {
            ffi::PROJ_GRID_AVAILABILITY_USE_PROJ_GRID_AVAILABILITY_KNOWN_AVAILABLE
        } else {
            ffi::PROJ_GRID_AVAILABILITY_USE_PROJ_GRID_AVAILABILITY_USED_FOR_SORTING
        };
        let context = self.0.as_ptr();
        // SAFETY: context and objects are alive and of one thread; the factory and the list are
        // destroyed before returning, and list items are owned copies.
        unsafe {
            let factory = ffi::proj_create_operation_factory_context(context, std::ptr::null());
            if factory.is_null() {
                return Err(failed(action, &self.message()));
            }
            if let Some([west, south, east, north]) = area {
                ffi::proj_operation_factory_context_set_area_of_interest(
                    context, factory, west, south, east, north,
                );
            }
            ffi::proj_operation_factory_context_set_spatial_criterion(
                context,
                factory,
                ffi::PROJ_SPATIAL_CRITERION_PROJ_SPATIAL_CRITERION_PARTIAL_INTERSECTION,
            );
            ffi::proj_operation_factory_context_set_grid_availability_use(
                context,
                factory,
                availability,
            );
            let list = ffi::proj_create_operations(
                context,
                source.pj.as_ptr(),
                target.pj.as_ptr(),
                factory,
            );
            ffi::proj_operation_factory_context_destroy(factory);
            if list.is_null() {
                return Err(failed(action, &self.message()));
            }
            let found = (0..ffi::proj_list_get_count(list))
                .map(|i| self.own(ffi::proj_list_get(context, list, i), action))
                .collect();
            ffi::proj_list_destroy(list);
            found
        }
    }

    fn own(self: &Rc<Self>, object: *mut ffi::PJ, action: &str) -> Result<Object, CrsError> {
        match NonNull::new(object) {
            Some(pj) => Ok(Object { pj, context: Rc::clone(self) }),
            None => Err(failed(action, &self.message())),
        }
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: owned, and every object made in it holds an `Rc` to it, so none is left.
        unsafe { ffi::proj_context_destroy(self.0.as_ptr()) };
    }
}

/// A grid file that an operation reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Grid {
    pub(super) name: String,
    pub(super) available: bool,
}

/// What kind of CRS an object is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Projected,
    Geographic,
    Compound,
    Bound,
    Other,
}

/// A CRS or an operation, with the context that it lives in.
#[derive(Debug)]
pub(super) struct Object {
    pj: NonNull<ffi::PJ>,
    context: Rc<Context>,
}

impl Object {
    fn context(&self) -> *mut ffi::PJ_CONTEXT {
        self.context.0.as_ptr()
    }

    /// Its name.
    pub(super) fn name(&self) -> String {
        // SAFETY: the object is alive; the string belongs to it and is copied.
        unsafe { text(ffi::proj_get_name(self.pj.as_ptr())) }.unwrap_or_default()
    }

    /// Its EPSG code, if it has one.
    pub(super) fn epsg(&self) -> Option<u32> {
        // SAFETY: the object is alive; the strings belong to it and are copied.
        let (authority, code) = unsafe {
            (
                text(ffi::proj_get_id_auth_name(self.pj.as_ptr(), 0))?,
                text(ffi::proj_get_id_code(self.pj.as_ptr(), 0))?,
            )
        };
        (authority == "EPSG").then(|| code.parse().ok())?
    }

    /// What kind of CRS it is.
    pub(super) fn kind(&self) -> Kind {
        // SAFETY: the object is alive.
        match unsafe { ffi::proj_get_type(self.pj.as_ptr()) } {
            ffi::PJ_TYPE_PJ_TYPE_PROJECTED_CRS => Kind::Projected,
            ffi::PJ_TYPE_PJ_TYPE_GEOGRAPHIC_2D_CRS | ffi::PJ_TYPE_PJ_TYPE_GEOGRAPHIC_3D_CRS => {
                Kind::Geographic
            }
            ffi::PJ_TYPE_PJ_TYPE_COMPOUND_CRS => Kind::Compound,
            ffi::PJ_TYPE_PJ_TYPE_BOUND_CRS => Kind::Bound,
            _ => Kind::Other,
        }
    }

    /// The horizontal part of a compound CRS.
    pub(super) fn horizontal(&self) -> Result<Self, CrsError> {
        // SAFETY: the object is alive; the result is owned.
        let part = unsafe { ffi::proj_crs_get_sub_crs(self.context(), self.pj.as_ptr(), 0) };
        self.context.own(part, "take the horizontal part of a compound CRS")
    }

    /// The CRS that a bound CRS is bound to a datum shift from.
    pub(super) fn source(&self) -> Result<Self, CrsError> {
        // SAFETY: the object is alive; the result is owned.
        let part = unsafe { ffi::proj_get_source_crs(self.context(), self.pj.as_ptr()) };
        self.context.own(part, "take the source of a bound CRS")
    }

    /// Metres (or radians) per unit of the first axis of a CRS.
    pub(super) fn axis_unit(&self) -> Result<f64, CrsError> {
        let action = "read the unit of an axis";
        // SAFETY: the object is alive; the result is owned.
        let axes = unsafe { ffi::proj_crs_get_coordinate_system(self.context(), self.pj.as_ptr()) };
        let axes = self.context.own(axes, action)?;
        let mut factor = f64::NAN;
        let null = std::ptr::null_mut();
        // SAFETY: the axes are alive; only the factor is asked for, the rest may be null.
        let ok = unsafe {
            ffi::proj_cs_get_axis_info(
                self.context(),
                axes.pj.as_ptr(),
                0,
                null,
                null,
                null,
                &raw mut factor,
                null,
                null,
                null,
            )
        };
        if ok == 1 { Ok(factor) } else { Err(failed(action, &self.context.message())) }
    }

    /// Area of use: west, south, east, north, degrees.
    pub(super) fn area_of_use(&self) -> Option<[f64; 4]> {
        let [mut west, mut south, mut east, mut north] = [0.0; 4];
        // SAFETY: the object is alive, out-pointers are valid; the name is not asked for.
        let ok = unsafe {
            ffi::proj_get_area_of_use(
                self.context(),
                self.pj.as_ptr(),
                &raw mut west,
                &raw mut south,
                &raw mut east,
                &raw mut north,
                std::ptr::null_mut(),
            )
        };
        // PROJ says -1000 for an unknown bound.
        let area = [west, south, east, north];
        (ok == 1 && area.iter().all(|bound| *bound >= -180.0)).then_some(area)
    }

    /// WKT 2 (2019) of a CRS.
    pub(super) fn wkt(&self) -> Option<String> {
        self.wkt_as(ffi::PJ_WKT_TYPE_PJ_WKT2_2019)
    }

    /// WKT of a CRS in one of PROJ's dialects.
    pub(super) fn wkt_as(&self, dialect: ffi::PJ_WKT_TYPE) -> Option<String> {
        // SAFETY: the object is alive; the string belongs to it and is copied.
        unsafe {
            text(ffi::proj_as_wkt(self.context(), self.pj.as_ptr(), dialect, std::ptr::null()))
        }
    }

    /// Stated accuracy of an operation, metres.
    pub(super) fn accuracy_m(&self) -> Option<f64> {
        // SAFETY: the object is alive.
        let accuracy =
            unsafe { ffi::proj_coordoperation_get_accuracy(self.context(), self.pj.as_ptr()) };
        (accuracy >= 0.0).then_some(accuracy)
    }

    /// Whether an operation can run here (its grids are there).
    pub(super) fn is_instantiable(&self) -> bool {
        // SAFETY: the object is alive.
        unsafe { ffi::proj_coordoperation_is_instantiable(self.context(), self.pj.as_ptr()) == 1 }
    }

    /// Whether an operation takes two datums for equal for want of knowledge.
    pub(super) fn is_ballpark(&self) -> bool {
        // SAFETY: the object is alive.
        unsafe {
            ffi::proj_coordoperation_has_ballpark_transformation(self.context(), self.pj.as_ptr())
                == 1
        }
    }

    /// Grid files of an operation.
    pub(super) fn grids(&self) -> Vec<Grid> {
        // SAFETY: the object is alive.
        let count = unsafe {
            ffi::proj_coordoperation_get_grid_used_count(self.context(), self.pj.as_ptr())
        };
        (0..count).filter_map(|index| self.grid(index)).collect()
    }

    fn grid(&self, index: c_int) -> Option<Grid> {
        let mut name: *const c_char = std::ptr::null();
        let mut available: c_int = 0;
        let (strings, flags) = (std::ptr::null_mut(), std::ptr::null_mut());
        // SAFETY: the object is alive, out-pointers are valid or null as PROJ allows; the string
        // belongs to the object and is copied.
        unsafe {
            let ok = ffi::proj_coordoperation_get_grid_used(
                self.context(),
                self.pj.as_ptr(),
                index,
                &raw mut name,
                strings,
                strings,
                strings,
                flags,
                flags,
                &raw mut available,
            );
            (ok == 1).then(|| text(name))?.map(|name| Grid { name, available: available == 1 })
        }
    }

    /// The same operation with longitude before latitude and easting before northing.
    pub(super) fn normalised(&self) -> Result<Self, CrsError> {
        // SAFETY: the object is alive; the result is owned.
        let object =
            unsafe { ffi::proj_normalize_for_visualization(self.context(), self.pj.as_ptr()) };
        self.context.own(object, "put longitude before latitude")
    }

    /// An operation as a pipeline, on one line.
    pub(super) fn pipeline(&self) -> Result<String, CrsError> {
        // SAFETY: the object is alive; the string belongs to it and is copied.
        let found = unsafe {
            text(ffi::proj_as_proj_string(
                self.context(),
                self.pj.as_ptr(),
                ffi::PJ_PROJ_STRING_TYPE_PJ_PROJ_5,
                std::ptr::null(),
            ))
        };
        found.ok_or_else(|| failed("write an operation as a pipeline", &self.context.message()))
    }

    /// Runs an operation, forward or inverse, on a pair of numbers.
    ///
    /// # Errors
    /// PROJ's message where it fails.
    pub(super) fn run(&self, at: (f64, f64), forward: bool) -> Result<Projected, String> {
        let direction = if forward { ffi::PJ_DIRECTION_PJ_FWD } else { ffi::PJ_DIRECTION_PJ_INV };
        let pj = self.pj.as_ptr();
        // SAFETY: the object is alive, and of this thread as all of its context; all four numbers of the
        // coordinate are plain `f64` in every variant of the union.
        let (v, code) = unsafe {
            ffi::proj_errno_reset(pj);
            // A time of HUGE_VAL says that there is none.
            let coordinate = ffi::PJ_COORD { v: [at.0, at.1, 0.0, f64::INFINITY] };
            let v = ffi::proj_trans(pj, direction, coordinate).v;
            (v, ffi::proj_errno(pj))
        };
        if code == 0 && v[0].is_finite() && v[1].is_finite() {
            return Ok(Projected { x: v[0], y: v[1] });
        }
        // SAFETY: the context is alive; the string is copied.
        let message = unsafe { text(ffi::proj_context_errno_string(self.context(), code)) };
        Err(message.filter(|_| code != 0).unwrap_or_else(|| "no result".to_owned()))
    }
}

impl Drop for Object {
    fn drop(&mut self) {
        // SAFETY: owned, and its context is alive.
        unsafe { ffi::proj_destroy(self.pj.as_ptr()) };
    }
}

/// A pipeline ready to run, with a context of its own.
#[derive(Debug)]
pub(super) struct Transform(Object);

// SAFETY: the context was made for this object alone and its one other `Rc` is inside the object,
// so the whole moves to another thread together; PROJ asks only that no two threads use a context
// at once, which `&mut self` on every method guarantees.
unsafe impl Send for Transform {}

impl Transform {
    /// Prepares a pipeline.
    pub(super) fn new(pipeline: &str, network: bool) -> Result<Self, CrsError> {
        Ok(Self(Context::new(network)?.create(pipeline)?))
    }

    /// Runs the pipeline, forward or inverse, on a pair of numbers.
    ///
    /// # Errors
    /// PROJ's message where it fails.
    pub(super) fn run(&mut self, at: (f64, f64), forward: bool) -> Result<Projected, String> {
        self.0.run(at, forward)
    }
}

/// PROJ's version.
pub(super) fn version() -> String {
    // SAFETY: returns a struct of pointers to static strings.
    unsafe { text(ffi::proj_info().version) }.unwrap_or_default()
}

/// Copies a C string; `None` for null.
///
/// # Safety
/// `string` is null or a terminated string that lives through the call.
unsafe fn text(string: *const c_char) -> Option<String> {
    // SAFETY: by the contract of this function.
    (!string.is_null()).then(|| unsafe { CStr::from_ptr(string) }.to_string_lossy().into_owned())
}

fn failed(action: &str, message: &str) -> CrsError {
    CrsError::Proj { action: action.to_owned(), message: message.to_owned() }
}
