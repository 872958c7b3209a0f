//! Requests to a Hugging Face hub.

use super::FetchError;
use std::io::Read as _;
use std::time::Duration;
use ureq::http::{Response, header};
use ureq::tls::{Certificate, PemItem, RootCerts, TlsConfig, parse_pem};
use ureq::{Agent, Body};

/// The public hub.
const ENDPOINT: &str = "https://huggingface.co";
/// Redirects that are followed at most.
const REDIRECTS: usize = 10;
/// Times that a request is made when the server is busy or cannot be reached.
pub(super) const ATTEMPTS: u32 = 4;
/// Longest answer that is read into memory, bytes.
const LONGEST_TEXT: u64 = 8 << 20;

/// A hub and how it is spoken to.
#[derive(Debug)]
pub struct Hub {
    endpoint: String,
    token: Option<String>,
    agent: Agent,
    /// Wait before the second attempt of a request; doubled before each further one.
    pause: Duration,
}

/// What a hub says about a file without sending it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct FileHead {
    /// Names the contents; the SHA-256 of large files.
    pub etag: String,
    /// Bytes, where the hub says so.
    pub size: Option<u64>,
}

impl Hub {
    /// The hub that the environment names: `HF_ENDPOINT`, with the token in `HF_TOKEN` (or
    /// `HUGGING_FACE_HUB_TOKEN`), the certificates of `SSL_CERT_FILE` (else Mozilla's), and the proxy of
    /// `HTTPS_PROXY` or `ALL_PROXY`.
    ///
    /// # Errors
    /// [`FetchError::Offline`] where `HF_HUB_OFFLINE` forbids it; [`FetchError::Value`] for a
    /// variable that makes no sense; [`FetchError::Io`] for certificates that cannot be read.
    pub fn from_environment() -> Result<Self, FetchError> {
        let text = |name: &'static str| match std::env::var(name) {
            Ok(value) if value.trim().is_empty() => Ok(None),
            Ok(value) => Ok(Some(value.trim().to_owned())),
            Err(std::env::VarError::NotPresent) => Ok(None),
            Err(error) => Err(FetchError::value(name, "", &error.to_string())),
        };
        for variable in ["HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"] {
            if text(variable)?.is_some_and(|value| is_true(&value)) {
                return Err(FetchError::Offline { variable });
            }
        }
        let endpoint = text("HF_ENDPOINT")?.unwrap_or_else(|| ENDPOINT.into());
        if !(endpoint.starts_with("https://") || endpoint.starts_with("http://")) {
            let why = "has to begin with https:// or http://";
            return Err(FetchError::value("HF_ENDPOINT", &endpoint, why));
        }
        let token = match text("HF_TOKEN")? {
            Some(token) => Some(token),
            None => text("HUGGING_FACE_HUB_TOKEN")?,
        };
        if token.as_ref().is_some_and(|token| !token.bytes().all(|byte| byte.is_ascii_graphic())) {
            // The value itself is secret.
            let why = "has characters that no token has (spaces, line ends, quotes of a shell)";
            return Err(FetchError::value("HF_TOKEN", "(not shown)", why));
        }
        let certificates = match text("SSL_CERT_FILE")? {
            Some(path) => certificates(&path)?,
            None => RootCerts::WebPki,
        };
        let agent = Agent::config_builder()
            .http_status_as_error(false)
            // Followed here: what is asked for lies in the headers of a redirect, and a token must
            // not go along to another host.
            .max_redirects(0)
            .max_redirects_will_error(false)
            .timeout_connect(Some(Duration::from_secs(20)))
            .timeout_recv_response(Some(Duration::from_secs(60)))
            .timeout_per_read(Some(Duration::from_secs(60)))
            .user_agent(concat!("sat3d/", env!("CARGO_PKG_VERSION")))
            .tls_config(TlsConfig::builder().root_certs(certificates).build())
            .build()
            .new_agent();
        let endpoint = endpoint.trim_end_matches('/').to_owned();
        Ok(Self { endpoint, token, agent, pause: Duration::from_secs(1) })
    }

    /// The address that requests go to.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Address of a file at a commit.
    pub(super) fn file_url(&self, repository: &str, commit: &str, path: &str) -> String {
        let path: Vec<String> = path.split('/').map(percent).collect();
        format!("{}/{repository}/resolve/{commit}/{}", self.endpoint, path.join("/"))
    }

    /// What the hub's interface says about a repository at a revision, with the sizes and hashes of
    /// its files.
    pub(super) fn listing(
        &self,
        repository: &str,
        revision: &str,
    ) -> Result<serde_json::Value, FetchError> {
        let revision = percent(revision);
        let url =
            format!("{}/api/models/{repository}/revision/{revision}?blobs=true", self.endpoint);
        let text = self.text(&url)?;
        serde_json::from_str(&text).map_err(|error| FetchError::Answer {
            url,
            why: format!("not JSON ({error}); is HF_ENDPOINT a Hugging Face hub?"),
        })
    }

    /// A small file or answer.
    pub(super) fn text(&self, url: &str) -> Result<String, FetchError> {
        let mut response = self.get(url, 0)?;
        let mut bytes = Vec::new();
        response
            .body_mut()
            .as_reader()
            .take(LONGEST_TEXT)
            .read_to_end(&mut bytes)
            .map_err(|error| FetchError::Network { url: url.into(), why: error.to_string() })?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }

    /// Asks for a file without its contents.
    pub(super) fn head(&self, url: &str) -> Result<FileHead, FetchError> {
        let response = self.ask(url, Question::Head)?;
        let text = |name: &str| response.headers().get(name).and_then(|v| v.to_str().ok());
        let etag = text("x-linked-etag").or_else(|| text("etag"));
        let etag = etag.map(|etag| etag.trim_start_matches("W/").trim_matches('"').to_owned());
        let Some(etag) = etag.filter(|etag| is_etag(etag)) else {
            let why = "no usable ETag header; is HF_ENDPOINT a Hugging Face hub?";
            return Err(FetchError::Answer { url: url.into(), why: why.into() });
        };
        let own = (!response.status().is_redirection()).then(|| text("content-length")).flatten();
        let size = text("x-linked-size").or(own).and_then(|size| size.parse().ok());
        Ok(FileHead { etag, size })
    }

    /// Asks for a file from a byte on.
    pub(super) fn get(&self, url: &str, from: u64) -> Result<Response<Body>, FetchError> {
        self.ask(url, Question::From(from))
    }

    /// Makes a request, again where the server is busy, and follows redirects; a redirect that says
    /// what it links to is itself the answer to a question without contents.
    fn ask(&self, url: &str, question: Question) -> Result<Response<Body>, FetchError> {
        let authorization = self.token.as_ref().map(|token| format!("Bearer {token}"));
        let (mut at, mut redirects, mut attempt) = (url.to_owned(), 0, 1);
        loop {
            let own = origin(&at) == origin(&self.endpoint);
            let token = authorization.as_deref().filter(|_| own);
            let response = match self.call(&at, question, token) {
                Ok(response) => response,
                Err(error) if attempt < ATTEMPTS && transient(&error) => {
                    self.wait(&mut attempt, None);
                    continue;
                }
                Err(error) => {
                    return Err(FetchError::Network { url: at, why: explained(&error) });
                }
            };
            let status = response.status();
            let text = |name: &str| response.headers().get(name).and_then(|v| v.to_str().ok());
            let linked = text("x-linked-etag").is_some();
            if status.is_redirection() && linked && matches!(question, Question::Head) {
                return Ok(response);
            }
            if let Some(location) = text("location").filter(|_| status.is_redirection()) {
                redirects += 1;
                let next = joined(&at, location);
                if redirects > REDIRECTS
                    || (at.starts_with("https:") && !next.starts_with("https:"))
                {
                    let why = format!("redirects to {next}, which is not followed");
                    return Err(FetchError::Answer { url: at, why });
                }
                at = next;
                continue;
            }
            if status.is_success() || status.as_u16() == 416 {
                return Ok(response);
            }
            if matches!(status.as_u16(), 408 | 429 | 500 | 502 | 503 | 504) && attempt < ATTEMPTS {
                let seconds = text("retry-after").and_then(|text| text.parse().ok());
                self.wait(&mut attempt, seconds.map(Duration::from_secs));
                continue;
            }
            let said = text("x-error-message").unwrap_or_default().to_owned();
            let code = text("x-error-code").unwrap_or_default().to_owned();
            let token = authorization.is_some();
            return Err(FetchError::refused(&at, status.as_u16(), &code, &said, token));
        }
    }

    fn call(
        &self,
        url: &str,
        question: Question,
        token: Option<&str>,
    ) -> Result<Response<Body>, ureq::Error> {
        let mut request = match question {
            Question::Head => self.agent.head(url),
            Question::From(_) => self.agent.get(url),
        }
        // Sizes and hashes are those of what is stored, not of what was compressed on the way.
        .header(header::ACCEPT_ENCODING, "identity");
        if let Question::From(from @ 1..) = question {
            request = request.header(header::RANGE, format!("bytes={from}-"));
        }
        if let Some(token) = token {
            request = request.header(header::AUTHORIZATION, token);
        }
        request.call()
    }

    /// Waits before another attempt, as long as the server asks for, within reason.
    pub(super) fn wait(&self, attempt: &mut u32, asked: Option<Duration>) {
        let own = self.pause * 2_u32.pow(*attempt - 1);
        std::thread::sleep(asked.unwrap_or(own).min(self.pause * 30));
        *attempt += 1;
    }
}

/// What is asked for.
#[derive(Clone, Copy, Debug)]
enum Question {
    /// Headers alone.
    Head,
    /// The contents from a byte on.
    From(u64),
}

/// The certificates of a file, in place of Mozilla's: that is what the variable means elsewhere.
fn certificates(path: &str) -> Result<RootCerts, FetchError> {
    let bytes = std::fs::read(path).map_err(FetchError::io(path))?;
    let found: Result<Vec<Certificate<'static>>, ureq::Error> = parse_pem(&bytes)
        .filter_map(|item| match item {
            Ok(PemItem::Certificate(certificate)) => Some(Ok(certificate)),
            Ok(_) => None,
            Err(error) => Some(Err(error)),
        })
        .collect();
    match found {
        Ok(list) if !list.is_empty() => Ok(list.into()),
        Ok(_) => Err(FetchError::value("SSL_CERT_FILE", path, "holds no certificate")),
        Err(error) => Err(FetchError::value("SSL_CERT_FILE", path, &error.to_string())),
    }
}

/// Truth as `huggingface_hub` reads it from a variable.
pub(super) fn is_true(value: &str) -> bool {
    matches!(value.to_ascii_uppercase().as_str(), "1" | "ON" | "YES" | "TRUE")
}

/// Whether an etag can be a file's name.
fn is_etag(etag: &str) -> bool {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.');
    (1..=128).contains(&etag.len()) && !etag.starts_with('.') && etag.bytes().all(plain)
}

/// One part of a path, escaped for an address.
fn percent(text: &str) -> String {
    let mut out = String::new();
    for byte in text.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' | b'.' | b'~' => {
                out.push(char::from(byte));
            }
            _ => out.push_str(&format!("%{byte:02X}")),
        }
    }
    out
}

/// Scheme, host and port of an address: a token is sent to one of these only.
fn origin(url: &str) -> &str {
    let start = url.find("://").map_or(0, |at| at + 3);
    let length = url[start..].find(['/', '?', '#']).unwrap_or(url.len() - start);
    &url[..start + length]
}

/// The address that a `Location` header means.
fn joined(at: &str, location: &str) -> String {
    if location.contains("://") {
        return location.to_owned();
    }
    if let Some(rest) = location.strip_prefix("//") {
        let scheme = at.split("://").next().unwrap_or("https");
        return format!("{scheme}://{rest}");
    }
    if location.starts_with('/') {
        return format!("{}{location}", origin(at));
    }
    let path = at.split(['?', '#']).next().unwrap_or(at);
    let folder = path.rfind('/').filter(|&end| end >= origin(at).len());
    format!("{}/{location}", folder.map_or(origin(at), |end| &path[..end]))
}

/// Whether a second attempt may succeed: the connection broke. A name that cannot be resolved, a port
/// that nobody listens on and a certificate that is not trusted stay so.
fn transient(error: &ureq::Error) -> bool {
    use std::io::ErrorKind::{
        BrokenPipe, ConnectionAborted, ConnectionReset, TimedOut, UnexpectedEof,
    };
    match error {
        ureq::Error::Timeout(_) => true,
        ureq::Error::Io(error) => matches!(
            error.kind(),
            BrokenPipe | ConnectionAborted | ConnectionReset | TimedOut | UnexpectedEof
        ),
        _ => false,
    }
}

fn explained(error: &ureq::Error) -> String {
    let text = error.to_string();
    let text = text.strip_prefix("io: ").unwrap_or(&text);
    match error {
        ureq::Error::HostNotFound => "the host's name cannot be resolved".into(),
        ureq::Error::ConnectionFailed => "no connection".into(),
        _ if text.contains("certificate") => {
            format!("{text} (SSL_CERT_FILE names a file of certificates to trust instead)")
        }
        _ => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_put_together() {
        for (at, location, expected) in [
            ("https://a.b/c/d", "/e?f", "https://a.b/e?f"),
            ("https://a.b:8/c/d?x=/y", "e", "https://a.b:8/c/e"),
            ("https://a.b", "e", "https://a.b/e"),
            ("https://a.b/c", "//f.g/h", "https://f.g/h"),
            ("https://a.b/c", "http://f.g/h", "http://f.g/h"),
        ] {
            assert_eq!(joined(at, location), expected, "{at} {location}");
        }
        assert_eq!(percent("refs/pr/1 ä"), "refs%2Fpr%2F1%20%C3%A4");
        assert_eq!(origin("https://a.b:8/c"), "https://a.b:8");
        // Neither another port nor a name that only begins alike is the same place.
        assert_ne!(origin("https://a.b:8/c"), origin("https://a.b/c"));
        assert_ne!(origin("https://a.b.evil/c"), origin("https://a.b/c"));
        assert_ne!(origin("https://a.b@evil/c"), origin("https://a.b/c"));
    }

    #[test]
    fn an_etag_that_is_a_path_is_refused() {
        assert!(is_etag("0123abc") && is_etag("d41d8cd98f-2"));
        for bad in ["", ".", "..", "../x", "a/b", "a\\b", ".hidden", "a b"] {
            assert!(!is_etag(bad), "{bad}");
        }
    }
}
