//! x
use sat3d as library;
#[path = "eval_support/sample.rs"]
mod sample;
#[test]
fn show() {
    use sat3d::eval::{Protocol, published, report};
    let mut one = sample::set(&["out"], &[Protocol::Paper], 100);
    println!("{}", report::terminal(&one, 80));
    one.published = published::paper_rows();
    println!("{}", report::terminal(&one, 80));
    println!("{}", report::terminal(&sample::set(&["out","baseline"], &[Protocol::Paper], 100), 80));
    println!("{}", report::terminal(&sample::set(&["out"], &Protocol::ALL, 100), 80));
    println!("{}", report::terminal(&sample::nothing(), 80));
}
