//! The server: one thread for each connection, few connections, time-outs everywhere.

use super::request::Heads;
use super::respond::{self, Answer};
use super::{Contents, ViewerError};
use crate::batch::Interrupt;
use std::io::{self, Read};
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// How often a wish to stop is looked for.
const TICK: Duration = Duration::from_millis(50);
/// How long answers under way may go on after that.
const GRACE: Duration = Duration::from_secs(2);

/// What a client may cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Connections at once; a browser opens six. Those beyond are answered 503.
    pub connections: usize,
    /// How long a connection may idle, and how long the head of a request may take.
    pub head: Duration,
    /// How long the client may take nothing of an answer.
    pub write: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self { connections: 64, head: Duration::from_secs(15), write: Duration::from_secs(30) }
    }
}

/// What was served.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Served {
    /// Requests that were answered, whatever the answer.
    pub requests: u64,
}

/// A folder served on 127.0.0.1.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    port: u16,
    shared: Arc<Shared>,
}

/// What the connections share.
#[derive(Debug)]
struct Shared {
    contents: Contents,
    limits: Limits,
    port: u16,
    stop: AtomicBool,
    connections: AtomicUsize,
    requests: AtomicU64,
}

impl Server {
    /// Listens on a port of 127.0.0.1 (0: a free one); nothing is answered before [`run`](Self::run).
    ///
    /// # Errors
    /// The port is taken or not allowed.
    pub fn bind(contents: Contents, port: u16, limits: Limits) -> Result<Self, ViewerError> {
        let listen = |source: io::Error| match source.kind() {
            io::ErrorKind::AddrInUse => ViewerError::PortInUse { port },
            _ => ViewerError::Listen { port, source },
        };
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(listen)?;
        let port = listener.local_addr().map_err(listen)?.port();
        let shared = Shared {
            contents,
            limits,
            port,
            stop: AtomicBool::new(false),
            connections: AtomicUsize::new(0),
            requests: AtomicU64::new(0),
        };
        Ok(Self { listener, port, shared: Arc::new(shared) })
    }

    /// The address of the page.
    #[must_use]
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/", self.port)
    }

    /// Answers until `interrupt` asks for a stop; answers under way then have two seconds to end.
    pub fn run(self, interrupt: &Interrupt) -> Served {
        let shared = Arc::clone(&self.shared);
        let listener = self.listener;
        let accepting = thread::spawn(move || accept(&listener, &shared));
        while !interrupt.requested() && !accepting.is_finished() {
            thread::sleep(TICK);
        }
        self.shared.stop.store(true, Ordering::SeqCst);
        // Wakes the listener, which waits for a connection.
        if TcpStream::connect((Ipv4Addr::LOCALHOST, self.port)).is_ok() {
            // A thread that panicked has said so.
            let _ = accepting.join();
        }
        let deadline = Instant::now() + GRACE;
        while self.shared.connections.load(Ordering::SeqCst) > 0 && Instant::now() < deadline {
            thread::sleep(TICK / 5);
        }
        Served { requests: self.shared.requests.load(Ordering::SeqCst) }
    }
}

/// Takes connections until the stop flag is set.
fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    for stream in listener.incoming() {
        if shared.stop.load(Ordering::SeqCst) {
            return;
        }
        let mut stream = match stream {
            Ok(stream) => stream,
            Err(error) => {
                // The client went away, or no file is free; the latter mends itself as connections end.
                tracing::debug!("a connection failed: {error}");
                thread::sleep(TICK / 5);
                continue;
            }
        };
        let Some(place) = Place::take(shared) else {
            let answer = Answer::text(503, "too many connections at once");
            // It fits the buffer of a new connection; whoever does not take it goes without.
            let _ = stream.set_write_timeout(Some(TICK));
            let _ = answer.send(&mut stream, false);
            continue;
        };
        let work = move || converse(&mut stream, &place.0);
        if let Err(error) = thread::Builder::new().name("viewer".to_owned()).spawn(work) {
            tracing::warn!("a connection was dropped, no thread for it: {error}");
        }
    }
}

/// One of the connections at once; given back when dropped, a panic included.
struct Place(Arc<Shared>);

impl Place {
    fn take(shared: &Arc<Shared>) -> Option<Self> {
        let count = shared.connections.fetch_add(1, Ordering::SeqCst);
        let place = Self(Arc::clone(shared));
        (count < shared.limits.connections).then_some(place)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.connections.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Answers the requests of one connection.
fn converse(stream: &mut TcpStream, shared: &Shared) {
    let limits = shared.limits;
    // Answers leave at once; without it small ones wait for the client's acknowledgement.
    let _ = stream.set_nodelay(true);
    if stream.set_write_timeout(Some(limits.write)).is_err() {
        return;
    }
    let mut heads = Heads::new();
    while !shared.stop.load(Ordering::SeqCst) {
        let (answer, keep) = match heads.next(stream, limits.head, &shared.stop) {
            Ok(request) => {
                let answer = respond::to(&request, &shared.contents, shared.port);
                tracing::info!("{} {} -> {}", request.method, request.target, answer.status);
                // What follows a refused request may be its body.
                let keep = request.keep && matches!(answer.status, 200 | 206 | 404 | 416);
                (answer, keep)
            }
            Err(problem) => match respond::to_no_request(&problem) {
                Some(answer) => (answer, false),
                None => return,
            },
        };
        shared.requests.fetch_add(1, Ordering::SeqCst);
        if let Err(error) = answer.send(stream, keep) {
            tracing::debug!("an answer was not taken: {error}");
            return;
        }
        if !keep {
            linger(stream);
            return;
        }
    }
}

/// Ends a connection so that the client gets the last answer: closing with bytes unread would reset it.
fn linger(stream: &mut TcpStream) {
    let _ = stream.shutdown(Shutdown::Write);
    let _ = stream.set_read_timeout(Some(TICK));
    let deadline = Instant::now() + 10 * TICK;
    let mut buffer = [0; 4096];
    while Instant::now() < deadline && stream.read(&mut buffer).is_ok_and(|count| count > 0) {}
}
