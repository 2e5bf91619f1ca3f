//! The files of the status page, which are compiled into the program.

use hyper::{Request, StatusCode};
use twox_hash::XxHash3_64;

use super::answer::{Answer, ResponseBody, answer, cached, not_found, not_modified};

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// The path of each file, its content type, and its content.
const ASSETS: [(&str, &str, &[u8]); 12] = [
    ("/", HTML, include_bytes!("page/index.html")),
    ("/page.css", CSS, include_bytes!("page/page.css")),
    ("/page.js", SCRIPT, include_bytes!("page/page.js")),
    ("/order.js", SCRIPT, include_bytes!("page/order.js")),
    ("/scene.js", SCRIPT, include_bytes!("page/scene.js")),
    ("/vendor/three.module.min.js", SCRIPT, include_bytes!("page/vendor/three.module.min.js")),
    ("/vendor/three.core.min.js", SCRIPT, include_bytes!("page/vendor/three.core.min.js")),
    ("/vendor/GLTFLoader.js", SCRIPT, include_bytes!("page/vendor/GLTFLoader.js")),
    ("/vendor/OrbitControls.js", SCRIPT, include_bytes!("page/vendor/OrbitControls.js")),
    ("/vendor/BufferGeometryUtils.js", SCRIPT, include_bytes!("page/vendor/BufferGeometryUtils.js")),
    ("/vendor/SkeletonUtils.js", SCRIPT, include_bytes!("page/vendor/SkeletonUtils.js")),
    ("/vendor/LICENSE", TEXT, include_bytes!("page/vendor/LICENSE")),
];

/// The response with the file at this path.
pub(super) fn asset<B>(request: &Request<B>) -> Answer {
    let found = ASSETS.iter().find(|(path, ..)| *path == request.uri().path());
    let Some(&(_, content_type, bytes)) = found else { return not_found() };
    let tag = format!("\"{:016x}\"", XxHash3_64::oneshot(bytes));
    let asset = || answer(StatusCode::OK, content_type, ResponseBody::full(bytes));
    not_modified(request, content_type, &tag).unwrap_or_else(|| cached(asset(), &tag))
}
