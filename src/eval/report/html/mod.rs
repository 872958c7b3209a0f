//! stub
/// p
pub struct Panel { /// a
pub caption: String, /// a
pub name: String, /// a
pub prediction: crate::eval::Surface, /// a
pub truth: crate::eval::Surface, /// a
pub mae_m: f64 }
/// h
pub fn html(_: &crate::eval::summary::EvaluationSet, _: &[Panel]) -> String { String::new() }
