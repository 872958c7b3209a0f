//! What is answered to a request.

use super::files::{self, Found, Part};
use super::request::{NoRequest, Request};
use super::{Contents, page};
use std::fmt::Write as _;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::net::TcpStream;

/// How much of a file is held in memory, bytes.
const CHUNK: usize = 64 * 1024;

/// An answer: status, header lines of its own, body.
pub(super) struct Answer {
    pub status: u16,
    /// Lines that end in CRLF, without Content-Length.
    headers: String,
    body: Body,
    /// Whether the body is left out (HEAD).
    headless: bool,
}

enum Body {
    Fixed(&'static [u8]),
    Owned(Vec<u8>),
    File { found: Found, start: u64, length: u64 },
}

impl Answer {
    /// A short text for people who look at the address by hand.
    pub(super) fn text(status: u16, text: &str) -> Self {
        let body = format!("{status} {}: {text}\n", reason(status)).into_bytes();
        Self::new(status, "text/plain; charset=utf-8", page::DATA_POLICY, Body::Owned(body))
    }

    fn new(status: u16, mime: &str, policy: &str, body: Body) -> Self {
        let headers = format!("Content-Type: {mime}\r\nContent-Security-Policy: {policy}\r\n");
        Self { status, headers, body, headless: false }
    }

    fn header(mut self, name: &str, value: &str) -> Self {
        let _ = write!(self.headers, "{name}: {value}\r\n");
        self
    }

    /// Writes the answer; `keep` says whether the connection stays open.
    ///
    /// # Errors
    /// The browser went away or is too slow, or the file became shorter while it was sent.
    pub(super) fn send(self, stream: &mut TcpStream, keep: bool) -> io::Result<()> {
        let length = match &self.body {
            Body::Fixed(bytes) => bytes.len() as u64,
            Body::Owned(bytes) => bytes.len() as u64,
            Body::File { length, .. } => *length,
        };
        let head = format!(
            "HTTP/1.1 {} {}\r\n{}Content-Length: {length}\r\nConnection: {}\r\n\
             Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\n\
             Cross-Origin-Resource-Policy: same-origin\r\nReferrer-Policy: no-referrer\r\n\r\n",
            self.status,
            reason(self.status),
            self.headers,
            if keep { "keep-alive" } else { "close" },
        );
        stream.write_all(head.as_bytes())?;
        if self.headless {
            return Ok(());
        }
        match self.body {
            Body::Fixed(bytes) => stream.write_all(bytes),
            Body::Owned(bytes) => stream.write_all(&bytes),
            Body::File { mut found, start, length } => {
                found.file.seek(SeekFrom::Start(start))?;
                send_file(&mut found.file, length, stream)
            }
        }
    }
}

/// Copies exactly `length` bytes.
fn send_file(file: &mut impl Read, length: u64, stream: &mut TcpStream) -> io::Result<()> {
    let mut buffer = vec![0; CHUNK];
    let mut left = length;
    while left > 0 {
        let most = usize::try_from(left).unwrap_or(CHUNK).min(CHUNK);
        let count = file.read(&mut buffer[..most])?;
        if count == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        stream.write_all(&buffer[..count])?;
        left -= count as u64;
    }
    Ok(())
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        206 => "Partial Content",
        400 => "Bad Request",
        404 => "Not Found",
        405 => "Method Not Allowed",
        408 => "Request Timeout",
        416 => "Range Not Satisfiable",
        421 => "Misdirected Request",
        431 => "Request Header Fields Too Large",
        503 => "Service Unavailable",
        _ => "Error",
    }
}

/// The answer to a connection that brought no request; none where nobody waits for one.
pub(super) fn to_no_request(problem: &NoRequest) -> Option<Answer> {
    match problem {
        NoRequest::Ended => None,
        NoRequest::Late => Some(Answer::text(408, "the request took too long")),
        NoRequest::TooLong => Some(Answer::text(431, "the request is too long")),
        NoRequest::Malformed => Some(Answer::text(400, "this is no HTTP request")),
    }
}

/// The answer to a request that arrived at `port`.
pub(super) fn to(request: &Request, contents: &Contents, port: u16) -> Answer {
    if !request.host.as_deref().is_some_and(|host| is_this_host(host, port)) {
        let text = format!("open http://127.0.0.1:{port}/ instead");
        return Answer::text(421, &text);
    }
    let head = request.method == "HEAD";
    if !head && request.method != "GET" {
        return Answer::text(405, "only GET and HEAD").header("Allow", "GET, HEAD");
    }
    if request.body {
        return Answer::text(400, "a request here has no body");
    }
    // A range is defined for GET alone.
    let range = request.range.as_deref().filter(|_| !head);
    let path = request.target.split(['?', '#']).next().unwrap_or_default();
    let mut answer = route(path, range, contents);
    answer.headless = head;
    answer
}

fn route(path: &str, range: Option<&str>, contents: &Contents) -> Answer {
    if let Some((bytes, mime)) = page::part(path) {
        return Answer::new(200, mime, page::POLICY, Body::Fixed(bytes));
    }
    if path == "/contents.json" {
        let name = contents.root().file_name().map(|name| name.to_string_lossy());
        let value = serde_json::json!({
            "sat3d": env!("CARGO_PKG_VERSION"),
            "name": name.unwrap_or_default(),
            "items": contents.items(),
        });
        let body = Body::Owned(value.to_string().into_bytes());
        return Answer::new(200, "application/json", page::DATA_POLICY, body);
    }
    let Some(found) = path.strip_prefix("/data/").and_then(|path| files::find(contents, path))
    else {
        return Answer::text(404, "there is no such file here");
    };
    let whole = found.length;
    let (status, start, length) = match files::part(range, whole) {
        Part::Whole => (200, 0, whole),
        Part::Bytes { start, length } => (206, start, length),
        Part::Outside => {
            return Answer::text(416, "the file is shorter than that")
                .header("Content-Range", &format!("bytes */{whole}"));
        }
    };
    let mime = found.mime;
    let answer = Answer::new(status, mime, page::DATA_POLICY, Body::File { found, start, length })
        .header("Accept-Ranges", "bytes");
    if status == 206 {
        let last = start + length - 1;
        return answer.header("Content-Range", &format!("bytes {start}-{last}/{whole}"));
    }
    answer
}

/// Whether a `Host` header names this server and not a web site whose name leads here.
fn is_this_host(host: &str, port: u16) -> bool {
    let (name, given) = host.split_once(':').unwrap_or((host, "80"));
    (name == "127.0.0.1" || name.eq_ignore_ascii_case("localhost")) && given == port.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_with_its_port_is_this_host() {
        for host in ["127.0.0.1:8123", "localhost:8123", "LOCALHOST:8123"] {
            assert!(is_this_host(host, 8123), "{host}");
        }
        for host in [
            "",
            "127.0.0.1",
            "localhost",
            "127.0.0.1:8124",
            "evil.example:8123",
            "localhost.evil.example:8123",
            "127.0.0.1:8123:1",
            "127.0.0.1:08123",
            "evil.example@127.0.0.1:8123",
        ] {
            assert!(!is_this_host(host, 8123), "{host}");
        }
        assert!(is_this_host("127.0.0.1", 80));
    }

    #[test]
    fn the_page_may_load_from_its_own_server_only() {
        let sources = page::POLICY.split(';').flat_map(|part| part.split_whitespace().skip(1));
        for source in sources {
            let own = ["'self'", "'none'", "'wasm-unsafe-eval'", "blob:", "data:"];
            assert!(own.contains(&source), "{source}");
        }
    }
}
