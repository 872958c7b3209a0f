//! Numbers as people read them.

/// What stands for a number that cannot be computed.
pub(super) const NONE: &str = "\u{2013}";

/// A number with `digits` decimals; [`NONE`] for NaN; powers of ten beyond a million. A number that
/// rounds to zero has no sign.
pub(super) fn fixed(value: f64, digits: usize) -> String {
    if value.is_nan() {
        return NONE.to_owned();
    }
    if value.is_infinite() {
        return if value > 0.0 { "\u{221e}" } else { "-\u{221e}" }.to_owned();
    }
    let text =
        if value.abs() >= 1e6 { format!("{value:.2e}") } else { format!("{value:.digits$}") };
    match text.strip_prefix('-') {
        Some(rest) if rest.bytes().all(|b| matches!(b, b'0' | b'.')) => rest.to_owned(),
        _ => text,
    }
}

/// [`fixed`] with a plus sign before what is above zero.
pub(super) fn signed(value: f64, digits: usize) -> String {
    let text = fixed(value, digits);
    if value > 0.0 && text.bytes().any(|b| b.is_ascii_digit() && b != b'0') {
        format!("+{text}")
    } else {
        text
    }
}

/// A count with commas between thousands.
pub(super) fn count(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::with_capacity(digits.len() * 4 / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// `low to high`, or [`NONE`] when either is unknown.
pub(super) fn range(low: f64, high: f64, digits: usize) -> String {
    if low.is_nan() || high.is_nan() {
        return NONE.to_owned();
    }
    format!("{} to {}", fixed(low, digits), fixed(high, digits))
}

/// A two-sided p-value.
pub(super) fn p_value(value: f64) -> String {
    if value < 0.001 { "< 0.001".to_owned() } else { fixed(value, 3) }
}

/// One or many: `1 image`, `2 images`.
pub(super) fn plural(number: u64, one: &str, many: &str) -> String {
    format!("{} {}", count(number), if number == 1 { one } else { many })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_computed_is_a_dash_and_zero_has_no_sign() {
        assert_eq!(fixed(f64::NAN, 2), "–");
        assert_eq!(fixed(-0.004, 2), "0.00");
        assert_eq!(fixed(-0.006, 2), "-0.01");
        assert_eq!(fixed(-0.0, 0), "0");
        assert_eq!(fixed(f64::INFINITY, 2), "∞");
        assert_eq!(fixed(-1.25e30, 2), "-1.25e30");
        assert_eq!(fixed(999_999.0, 1), "999999.0");
        assert_eq!(signed(0.5, 1), "+0.5");
        assert_eq!(signed(0.001, 2), "0.00");
        assert_eq!(signed(-0.5, 1), "-0.5");
        assert_eq!(signed(f64::NAN, 1), "–");
        assert_eq!(range(1.0, f64::NAN, 2), "–");
        assert_eq!(range(-1.0, 2.5, 1), "-1.0 to 2.5");
    }

    #[test]
    fn counts_have_commas_and_p_values_a_floor() {
        assert_eq!(count(0), "0");
        assert_eq!(count(999), "999");
        assert_eq!(count(1000), "1,000");
        assert_eq!(count(u64::MAX), "18,446,744,073,709,551,615");
        assert_eq!(p_value(0.0), "< 0.001");
        assert_eq!(p_value(0.0123), "0.012");
        assert_eq!(p_value(f64::NAN), "–");
        assert_eq!(plural(1, "image", "images"), "1 image");
        assert_eq!(plural(2000, "image", "images"), "2,000 images");
    }
}
