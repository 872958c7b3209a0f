//! Text for pages that the program writes.

/// Text that is safe in HTML text and attributes. Control characters become spaces.
pub(crate) fn escape(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            c if c.is_control() => safe.push(' '),
            c => safe.push(c),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_from_outside_cannot_leave_its_place() {
        assert_eq!(
            escape("<script>'\"&\u{0}\n</script>"),
            "&lt;script&gt;&#39;&quot;&amp;  &lt;/script&gt;"
        );
        assert_eq!(escape("größer 东京"), "größer 东京");
    }
}
