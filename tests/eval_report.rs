//! x
use sat3d as library;
#[path = "eval_support/sample.rs"]
mod sample;
#[test]
fn show() {
    use sat3d::eval::{Protocol, published, report};
    let mut one = sample::set(&["out"], &[Protocol::Paper], 100);
    one.published = published::paper_rows();
    let w = |n: &str, t: String| std::fs::write(format!("/tmp/rep/{n}.html"), t).unwrap();
    w("one", report::html(&one, &sample::panels()));
    w(
        "two",
        report::html(
            &sample::set(&["out", "baseline"], &[Protocol::Paper], 100),
            &sample::panels(),
        ),
    );
    w(
        "eight",
        report::html(&sample::set(&["out", "baseline"], &Protocol::ALL, 400), &sample::panels()),
    );
    w("nothing", report::html(&sample::nothing(), &[]));
    w("big", report::html(&sample::set(&["out"], &[Protocol::Paper], 12000), &[]));
}
