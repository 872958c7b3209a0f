//! The head of a request: read from a connection, parsed by `httparse`, reduced to what the server looks at.

use std::io::{self, Read};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Longest head that is read, bytes; browsers send about 1000.
const LONGEST_HEAD: usize = 16 * 1024;
/// How often a wish to stop is looked for.
const TICK: Duration = Duration::from_millis(200);
/// Most header lines of a head.
const MOST_HEADERS: usize = 100;

/// What a browser asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Request {
    /// GET, HEAD, or whatever was sent.
    pub method: String,
    /// Path and query as sent.
    pub target: String,
    /// The `Host` header, if there is exactly one.
    pub host: Option<String>,
    /// The `Range` header, unless an `If-Range` stands beside it (there is nothing it could match).
    pub range: Option<String>,
    /// Whether a body is announced.
    pub body: bool,
    /// Whether the connection stays open for another request.
    pub keep: bool,
}

/// Why there is no request.
#[derive(Debug)]
pub(super) enum NoRequest {
    /// The connection ended or idled between requests.
    Ended,
    /// The head did not arrive in time.
    Late,
    /// The head is longer than is read.
    TooLong,
    /// That is no HTTP.
    Malformed,
}

/// Reads heads from a connection, keeping what came after one for the next.
pub(super) struct Heads {
    buffer: Vec<u8>,
}

impl Heads {
    pub(super) fn new() -> Self {
        Self { buffer: Vec::with_capacity(2048) }
    }

    /// The next request: its first byte within `limit`, and its head within another. None once `stop` is set.
    pub(super) fn next(
        &mut self,
        stream: &mut TcpStream,
        limit: Duration,
        stop: &AtomicBool,
    ) -> Result<Request, NoRequest> {
        let mut deadline = Instant::now() + limit;
        let mut chunk = [0; 4096];
        loop {
            if let Some((length, request)) = parse(&self.buffer)? {
                self.buffer.drain(..length);
                return Ok(request);
            }
            if self.buffer.len() > LONGEST_HEAD {
                return Err(NoRequest::TooLong);
            }
            let idle = self.buffer.is_empty();
            let end = if idle { NoRequest::Ended } else { NoRequest::Late };
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() || stream.set_read_timeout(Some(left.min(TICK))).is_err() {
                return Err(end);
            }
            if stop.load(Ordering::SeqCst) {
                return Err(NoRequest::Ended);
            }
            match stream.read(&mut chunk) {
                Ok(0) => return Err(NoRequest::Ended),
                Ok(count) => {
                    if idle {
                        deadline = Instant::now() + limit;
                    }
                    self.buffer.extend_from_slice(&chunk[..count]);
                }
                Err(error) if is_pause(&error) => {}
                Err(_) => return Err(NoRequest::Ended),
            }
        }
    }
}

/// Whether reading may go on: a signal came, or nothing did for a while.
fn is_pause(error: &io::Error) -> bool {
    let kinds = [io::ErrorKind::Interrupted, io::ErrorKind::WouldBlock, io::ErrorKind::TimedOut];
    kinds.contains(&error.kind())
}

/// The request at the start of `bytes` and the length of its head; none while the head is incomplete.
fn parse(bytes: &[u8]) -> Result<Option<(usize, Request)>, NoRequest> {
    let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
    let mut head = httparse::Request::new(&mut headers);
    let length = match head.parse(bytes) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(httparse::Error::TooManyHeaders) => return Err(NoRequest::TooLong),
        Err(_) => return Err(NoRequest::Malformed),
    };
    let values = |name: &str| -> Vec<&[u8]> {
        let same = head.headers.iter().filter(|header| header.name.eq_ignore_ascii_case(name));
        same.map(|header| header.value).collect()
    };
    let one = |name: &str| match values(name)[..] {
        [value] => str::from_utf8(value).ok().map(|text| text.trim().to_owned()),
        _ => None,
    };
    let body = !values("transfer-encoding").is_empty()
        || values("content-length").iter().any(|value| value.trim_ascii() != b"0");
    let connection = one("connection").unwrap_or_default().to_ascii_lowercase();
    let closes = connection.split(',').any(|word| word.trim() == "close");
    Ok(Some((
        length,
        Request {
            method: head.method.unwrap_or_default().to_owned(),
            target: head.path.unwrap_or_default().to_owned(),
            host: one("host"),
            range: if values("if-range").is_empty() { one("range") } else { None },
            body,
            keep: head.version == Some(1) && !closes,
        },
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(text: &str) -> Request {
        let (length, request) = parse(text.as_bytes()).expect("HTTP").expect("a whole head");
        assert_eq!(length, text.len());
        request
    }

    #[test]
    fn a_head_is_reduced_to_what_matters() {
        let text = "GET /a?b HTTP/1.1\r\nHost: 127.0.0.1:80 \r\nrange: bytes=0-1\r\n\r\n";
        let expected = Request {
            method: "GET".into(),
            target: "/a?b".into(),
            host: Some("127.0.0.1:80".into()),
            range: Some("bytes=0-1".into()),
            body: false,
            keep: true,
        };
        assert_eq!(request(text), expected);
        assert!(parse(&text.as_bytes()[..text.len() - 1]).expect("HTTP").is_none());
    }

    #[test]
    fn two_hosts_are_none_and_bodies_are_seen() {
        let two = request("GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n");
        assert_eq!(two.host, None);
        assert!(request("GET / HTTP/1.1\r\nContent-Length: 3\r\n\r\n").body);
        assert!(request("GET / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n").body);
        assert!(!request("GET / HTTP/1.1\r\nContent-Length: 0\r\n\r\n").body);
        assert!(request("GET / HTTP/1.1\r\nContent-Length: 0\r\nContent-Length: 3\r\n\r\n").body);
    }

    #[test]
    fn connections_close_when_asked_and_for_old_clients() {
        assert!(!request("GET / HTTP/1.0\r\n\r\n").keep);
        assert!(!request("GET / HTTP/1.1\r\nConnection: TE, Close\r\n\r\n").keep);
        let ranged = request("GET / HTTP/1.1\r\nRange: bytes=0-1\r\nIf-Range: \"a\"\r\n\r\n");
        assert_eq!(ranged.range, None);
    }

    #[test]
    fn what_is_no_http_is_refused() {
        for text in ["\u{16}\u{3}\u{1}nonsense\r\n\r\n", "GET / HTTP/1.1\r\nHost : a\r\n\r\n"] {
            assert!(matches!(parse(text.as_bytes()), Err(NoRequest::Malformed)), "{text:?}");
        }
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(MOST_HEADERS + 1));
        assert!(matches!(parse(many.as_bytes()), Err(NoRequest::TooLong)));
    }
}
