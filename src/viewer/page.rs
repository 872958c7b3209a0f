//! The page and its script, which are inside the program.

/// What the browser may do with the page and its script. Pictures of tiles are blobs that the script makes out of
/// the bytes of a glb; the decoder of compressed meshes is WebAssembly inside the script.
pub(super) const POLICY: &str = "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; \
     img-src 'self' blob: data:; connect-src 'self' blob: data:; object-src 'none'; base-uri 'none'; \
     form-action 'none'; frame-ancestors 'none'";

/// What the browser may do with a file of the folder that is opened by itself: show it, run nothing.
pub(super) const DATA_POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; sandbox; frame-ancestors 'none'";

/// The bytes and MIME type of a part of the page.
pub(super) fn part(path: &str) -> Option<(&'static [u8], &'static str)> {
    Some(match path {
        "/" | "/index.html" => {
            (include_bytes!("../../viewer/dist/index.html"), "text/html; charset=utf-8")
        }
        "/viewer.js" => {
            (include_bytes!("../../viewer/dist/viewer.js"), "text/javascript; charset=utf-8")
        }
        "/viewer.css" => {
            (include_bytes!("../../viewer/dist/viewer.css"), "text/css; charset=utf-8")
        }
        "/licences.txt" => (include_bytes!("../../viewer/NOTICE"), "text/plain; charset=utf-8"),
        _ => return None,
    })
}
