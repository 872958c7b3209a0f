//! Process-wide settings of GDAL: its block cache, its messages, and no network.
#![expect(unsafe_code, reason = "the `gdal` crate has no safe call for the size of GDAL's cache")]

use std::sync::Once;

/// GDAL's cache until someone asks for another size. Blocks of GeoTIFFs do not go through it.
const DEFAULT_CACHE_BYTES: usize = 32 << 20;

/// Sets GDAL up, once; called before every use of GDAL.
pub(crate) fn set_up() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        set_cache(DEFAULT_CACHE_BYTES);
        // Errors come back as results; GDAL would print each to stderr beside that.
        gdal::config::set_error_handler(|class, number, message| {
            tracing::debug!(?class, number, message, "GDAL");
        });
        // Tiles are local files. A VRT must not fetch its sources from elsewhere: no file has this
        // name, so none is allowed.
        let offline = [("CPL_VSIL_CURL_ALLOWED_FILENAME", "none"), ("GDAL_HTTP_MAX_RETRY", "0")];
        for (key, value) in offline {
            if let Err(error) = gdal::config::set_config_option(key, value) {
                tracing::warn!("GDAL does not take the setting {key}: {error}");
            }
        }
    });
}

/// Gives GDAL's block cache a size in bytes, so that it is part of the memory that the user allows.
pub(crate) fn limit_gdal_cache(bytes: usize) {
    set_up();
    set_cache(bytes);
}

fn set_cache(bytes: usize) {
    let bytes = i64::try_from(bytes).unwrap_or(i64::MAX);
    // SAFETY: takes a number, guards its state with GDAL's own mutex, and keeps no pointer.
    unsafe { gdal_sys::GDALSetCacheMax64(bytes) };
}
