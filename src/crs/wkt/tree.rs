//! The syntax of WKT: a keyword with values in brackets, which may be nodes themselves.

/// Deepest nesting that is read; real definitions stay below 10.
const MAX_DEPTH: usize = 50;

/// `KEYWORD["text", 1.5, CHILD[...], bare]`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Node {
    /// In capitals.
    pub keyword: String,
    pub values: Vec<Value>,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Text(String),
    Number(f64),
    /// An unquoted word without brackets: `EAST`, `ellipsoidal`.
    Word(String),
    Node(Node),
}

impl Node {
    /// Parses a whole definition.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let mut parser = Parser { rest: text.trim_start_matches('\u{feff}').trim() };
        match parser.value(0)? {
            Value::Node(node) if parser.rest.trim().is_empty() => Ok(node),
            Value::Node(_) => Err(format!("unexpected `{}` after its end", parser.here())),
            _ => Err("expected a keyword with brackets".to_owned()),
        }
    }

    /// Whether the keyword is one of these.
    pub(super) fn is(&self, keywords: &[&str]) -> bool {
        keywords.contains(&self.keyword.as_str())
    }

    /// All child nodes.
    pub(super) fn children(&self) -> impl Iterator<Item = &Self> {
        self.values.iter().filter_map(|value| match value {
            Value::Node(node) => Some(node),
            _ => None,
        })
    }

    /// First child with one of these keywords.
    pub(super) fn child(&self, keywords: &[&str]) -> Option<&Self> {
        self.children().find(|node| node.is(keywords))
    }

    /// First text, which is the name of most nodes.
    pub(super) fn name(&self) -> Option<&str> {
        self.values.iter().find_map(|value| match value {
            Value::Text(text) => Some(text.as_str()),
            _ => None,
        })
    }

    /// The `i`-th value as a number; texts that hold one count (`AUTHORITY["EPSG","2927"]`).
    pub(super) fn number(&self, i: usize) -> Option<f64> {
        match self.values.get(i)? {
            Value::Number(number) => Some(*number),
            Value::Text(text) => text.trim().parse().ok(),
            _ => None,
        }
    }

    /// EPSG code of this very node.
    pub(super) fn epsg(&self) -> Option<u32> {
        let id = self
            .children()
            .filter(|node| node.is(&["AUTHORITY", "ID"]))
            .find(|node| node.name().is_some_and(|name| name.eq_ignore_ascii_case("EPSG")))?;
        let code = id.number(1)?;
        (code.fract() == 0.0 && (1.0..1e9).contains(&code)).then_some(code as u32)
    }
}

struct Parser<'a> {
    rest: &'a str,
}

impl Parser<'_> {
    fn here(&self) -> String {
        self.rest.chars().take(20).collect()
    }

    fn skip(&mut self) {
        self.rest = self.rest.trim_start();
    }

    fn eat(&mut self, options: &[char]) -> Option<char> {
        self.skip();
        let found = self.rest.chars().next().filter(|c| options.contains(c))?;
        self.rest = &self.rest[found.len_utf8()..];
        Some(found)
    }

    fn value(&mut self, depth: usize) -> Result<Value, String> {
        if depth > MAX_DEPTH {
            return Err(format!("more than {MAX_DEPTH} brackets inside each other"));
        }
        // Some writers use typographic quotes; ISO 19162 allows them.
        match self.eat(&['"', '\u{201c}']) {
            Some('"') => return self.quoted('"').map(Value::Text),
            Some(_) => return self.quoted('\u{201d}').map(Value::Text),
            None => {}
        }
        let end = self
            .rest
            .find(|c: char| c.is_whitespace() || "[](),\"".contains(c))
            .unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        if word.is_empty() {
            return Err(match self.here() {
                end if end.is_empty() => "it ends too early".to_owned(),
                here => format!("expected a value at `{here}`"),
            });
        }
        self.rest = rest;
        let close = match self.eat(&['[', '(']) {
            Some('[') => ']',
            Some(_) => ')',
            None => {
                // Words first: `inf` and `nan` are words, and Rust would read them as numbers.
                let number = word.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
                let number = if number { word.parse().ok() } else { None };
                return Ok(number.map_or_else(|| Value::Word(word.to_owned()), Value::Number));
            }
        };
        let mut node = Node { keyword: word.to_ascii_uppercase(), values: Vec::new() };
        if self.eat(&[close]).is_some() {
            return Ok(Value::Node(node));
        }
        loop {
            node.values.push(self.value(depth + 1)?);
            match self.eat(&[',', close]) {
                Some(',') => {}
                Some(_) => return Ok(Value::Node(node)),
                None if self.rest.is_empty() => {
                    return Err(format!("the bracket of {} is never closed", node.keyword));
                }
                None => return Err(format!("expected `,` or `{close}` at `{}`", self.here())),
            }
        }
    }

    /// The rest of a quoted text; a doubled quote stands for one.
    fn quoted(&mut self, quote: char) -> Result<String, String> {
        let mut text = String::new();
        loop {
            let end = self.rest.find(quote).ok_or("a quote is never closed")?;
            text.push_str(&self.rest[..end]);
            self.rest = &self.rest[end + quote.len_utf8()..];
            if !self.rest.starts_with(quote) {
                return Ok(text);
            }
            text.push(quote);
            self.rest = &self.rest[quote.len_utf8()..];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn nodes_words_numbers_and_quotes() {
        let node = Node::parse(
            " Unit ( \"say \"\"foot\"\"\", -3.048e-1 , AXIS[\"E\",EAST], AUTHORITY[\"EPSG\",\"9002\"] ) ",
        )
        .expect("WKT");
        assert_eq!(node.keyword, "UNIT");
        assert_eq!(node.name(), Some("say \"foot\""));
        assert_eq!(node.number(1), Some(-0.3048));
        assert_eq!(node.epsg(), Some(9002));
        let axis = node.child(&["AXIS"]).expect("a child");
        assert_eq!(axis.values[1], Value::Word("EAST".to_owned()));
    }

    #[test]
    fn what_is_broken_is_said() {
        for (text, reason) in [
            ("", "ends too early"),
            ("PROJCS", "brackets"),
            ("PROJCS[\"a", "quote"),
            ("PROJCS[\"a\"", "never closed"),
            ("PROJCS[\"a\" \"b\"]", "expected `,`"),
            ("PROJCS[\"a\",]", "expected a value"),
            ("PROJCS[\"a\"]]", "after its end"),
            ("PROJCS[\"a\")", "expected `,`"),
        ] {
            let error = Node::parse(text).expect_err(text);
            assert!(error.contains(reason), "{text}: {error}");
        }
        let deep = "A[".repeat(10_000);
        assert!(Node::parse(&deep).expect_err("deep").contains("inside each other"));
    }

    proptest! {
        #[test]
        fn no_text_makes_the_parser_panic(text in "[A-Z\\[\\]\\(\\)\",.0-9 \u{201c}\u{201d}é-]{0,60}") {
            let _ = Node::parse(&text);
        }
    }
}
