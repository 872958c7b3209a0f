//! A Hugging Face hub in miniature: a server for the interface and small files, and another one, of
//! another origin, that large files are redirected to.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sha1::Sha1;
use sha2::{Digest, Sha256};
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

pub const COMMIT: &str = "89abcdef0123456789abcdef0123456789abcdef";
pub const NAME: &str = "qian43/Sat3DGen";

/// How the hub misbehaves.
#[derive(Clone, Default)]
pub struct Behaviour {
    /// Status, `X-Error-Code` and message of everything.
    pub refuse: Option<(u16, &'static str, &'static str)>,
    /// Answers 503 to so many requests first.
    pub busy: usize,
    /// Breaks the connection after so many bytes of a large file, so many times.
    pub cut: Option<(usize, usize)>,
    /// Sends a large file whole, whatever range was asked for.
    pub without_ranges: bool,
    /// Changes a byte of large files on the way.
    pub damage: bool,
    /// States this size for large files.
    pub stated_size: Option<u64>,
    /// Waits after every 64 KiB of a large file.
    pub slow: Option<Duration>,
}

/// One request, as far as tests look at it.
#[derive(Clone, Debug)]
pub struct Seen {
    pub method: String,
    pub path: String,
    pub range: Option<String>,
    pub authorization: Option<String>,
    /// Whether it came to the server of large files.
    pub large: bool,
}

struct State {
    files: Vec<(String, Vec<u8>)>,
    card: serde_json::Value,
    behaviour: Behaviour,
    seen: Vec<Seen>,
}

/// The two servers; they end with the test's process.
pub struct Hub {
    state: Arc<Mutex<State>>,
    pub endpoint: String,
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

pub fn git(bytes: &[u8]) -> String {
    let mut hash = Sha1::new();
    hash.update(format!("blob {}\0", bytes.len()));
    hash.update(bytes);
    hex(&hash.finalize())
}

fn is_large(path: &str) -> bool {
    path.ends_with(".safetensors")
}

impl Hub {
    /// Serves files as [`NAME`] at `main`.
    pub fn new(files: Vec<(String, Vec<u8>)>, card: serde_json::Value) -> Self {
        let behaviour = Behaviour::default();
        let state = Arc::new(Mutex::new(State { files, card, behaviour, seen: Vec::new() }));
        let listen = |large: Option<u16>| {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            let port = listener.local_addr().unwrap().port();
            let state = state.clone();
            std::thread::spawn(move || {
                for stream in listener.incoming().filter_map(Result::ok) {
                    let state = state.clone();
                    // A client that goes away is the test's doing.
                    std::thread::spawn(move || _ = answer(stream, &state, large));
                }
            });
            port
        };
        let storage = listen(None);
        let endpoint = format!("http://127.0.0.1:{}", listen(Some(storage)));
        Self { state, endpoint }
    }

    pub fn behave(&self, behaviour: Behaviour) {
        self.state.lock().unwrap().behaviour = behaviour;
    }

    /// The requests since the last call.
    pub fn seen(&self) -> Vec<Seen> {
        std::mem::take(&mut self.state.lock().unwrap().seen)
    }
}

/// One request per connection. `storage`: the port of large files, or none for that server itself.
fn answer(stream: TcpStream, state: &Mutex<State>, storage: Option<u16>) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let mut first = String::new();
    reader.read_line(&mut first)?;
    let mut words = first.split_whitespace().map(str::to_owned);
    let (Some(method), Some(path)) = (words.next(), words.next()) else { return Ok(()) };
    let (mut range, mut authorization) = (None, None);
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let Some((name, value)) = line.trim_end().split_once(": ") else { break };
        match name.to_ascii_lowercase().as_str() {
            "range" => range = Some(value.to_owned()),
            "authorization" => authorization = Some(value.to_owned()),
            _ => {}
        }
    }
    let seen = Seen { method, path, range, authorization, large: storage.is_none() };
    let (files, card, behaviour) = {
        let mut state = state.lock().unwrap();
        state.seen.push(seen.clone());
        let behaviour = state.behaviour.clone();
        state.behaviour.busy = behaviour.busy.saturating_sub(1);
        (state.files.clone(), state.card.clone(), behaviour)
    };
    let mut out = stream;
    if let Some((status, code, message)) = behaviour.refuse {
        let headers = format!("X-Error-Code: {code}\r\nX-Error-Message: {message}\r\n");
        return reply(&mut out, status, &headers, b"", &seen);
    }
    if behaviour.busy > 0 {
        return reply(&mut out, 503, "Retry-After: 0\r\n", b"", &seen);
    }
    let Some(storage) = storage else {
        return large(&mut out, &seen, &files, state, &behaviour);
    };
    if seen.path.split('?').next() == Some(&format!("/api/models/{NAME}/revision/main")) {
        let siblings: Vec<serde_json::Value> = files
            .iter()
            .map(|(path, bytes)| match is_large(path) {
                true => serde_json::json!({
                    "rfilename": path, "blobId": git(b"a note in its place"),
                    "size": behaviour.stated_size.unwrap_or(bytes.len() as u64),
                    "lfs": {"sha256": sha256(bytes), "size": bytes.len(), "pointerSize": 135},
                }),
                false => {
                    serde_json::json!({"rfilename": path, "blobId": git(bytes), "size": bytes.len()})
                }
            })
            .collect();
        let listing = serde_json::json!({
            "id": NAME, "sha": COMMIT, "cardData": card, "siblings": siblings,
        });
        return reply(&mut out, 200, "", listing.to_string().as_bytes(), &seen);
    }
    let file = seen.path.strip_prefix(&format!("/{NAME}/resolve/{COMMIT}/"));
    match file.and_then(|file| files.iter().find(|(path, _)| path == file)) {
        Some((path, bytes)) if is_large(path) => {
            let hash = sha256(bytes);
            let size = behaviour.stated_size.unwrap_or(bytes.len() as u64);
            let headers = format!(
                "X-Repo-Commit: {COMMIT}\r\nX-Linked-Etag: \"{hash}\"\r\nX-Linked-Size: {size}\r\n\
                 Location: http://127.0.0.1:{storage}/{hash}?signature=abc\r\n"
            );
            reply(&mut out, 302, &headers, b"Found", &seen)
        }
        Some((_, bytes)) => {
            let headers = format!("X-Repo-Commit: {COMMIT}\r\nETag: W/\"{}\"\r\n", git(bytes));
            reply(&mut out, 200, &headers, bytes, &seen)
        }
        None => reply(&mut out, 404, "X-Error-Code: RepoNotFound\r\n", b"", &seen),
    }
}

fn reply(
    out: &mut TcpStream,
    status: u16,
    headers: &str,
    body: &[u8],
    seen: &Seen,
) -> std::io::Result<()> {
    let length = body.len();
    write!(
        out,
        "HTTP/1.1 {status} X\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n"
    )?;
    if seen.method != "HEAD" {
        out.write_all(body)?;
    }
    out.flush()
}

/// A large file from a byte on, with everything that can go wrong.
fn large(
    out: &mut TcpStream,
    seen: &Seen,
    files: &[(String, Vec<u8>)],
    state: &Mutex<State>,
    behaviour: &Behaviour,
) -> std::io::Result<()> {
    let hash = seen.path.trim_start_matches('/').split('?').next().unwrap_or_default();
    let Some((_, bytes)) = files.iter().find(|(_, bytes)| sha256(bytes) == hash) else {
        return reply(out, 404, "", b"", seen);
    };
    let mut bytes = bytes.clone();
    if behaviour.damage {
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
    }
    let from = seen.range.as_ref().filter(|_| !behaviour.without_ranges);
    let from = from.and_then(|range| range.strip_prefix("bytes=")?.strip_suffix('-'));
    let from: usize = from.map_or(0, |from| from.parse().unwrap());
    if from >= bytes.len() {
        return reply(out, 416, "", b"", seen);
    }
    let (total, body) = (bytes.len(), &bytes[from..]);
    let status = if from > 0 { 206 } else { 200 };
    write!(out, "HTTP/1.1 {status} X\r\nConnection: close\r\nContent-Length: {}\r\n", body.len())?;
    if from > 0 {
        write!(out, "Content-Range: bytes {from}-{}/{total}\r\n", total - 1)?;
    }
    write!(out, "ETag: \"of-the-storage\"\r\n\r\n")?;
    let mut limit = body.len();
    if let Some((after, times @ 1..)) = behaviour.cut {
        limit = limit.min(after);
        state.lock().unwrap().behaviour.cut = Some((after, times - 1));
    }
    for piece in body[..limit].chunks(1 << 16) {
        out.write_all(piece)?;
        behaviour.slow.into_iter().for_each(std::thread::sleep);
    }
    out.flush()
}
