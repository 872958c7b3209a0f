//! `sat3d view`: what its server gives and refuses, how it ends, and that its page needs no network.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{run, sat3d, stderr};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use tempfile::TempDir;

/// Binary glTF without a scene: 12 bytes of header and the smallest document.
fn glb() -> Vec<u8> {
    let json = br#"{"asset":{"version":"2.0"}}     "#;
    let mut bytes = b"glTF\x02\0\0\0".to_vec();
    bytes.extend((12 + 8 + json.len() as u32).to_le_bytes());
    bytes.extend((json.len() as u32).to_le_bytes());
    bytes.extend(b"JSON");
    bytes.extend(json);
    bytes
}

const TILESET: &str = r#"{"asset":{"version":"1.1"},"geometricError":1,"root":{"geometricError":0,
    "boundingVolume":{"sphere":[0,0,0,1]},"content":{"uri":"tiles/0 0.glb"}}}"#;

/// city/tileset.json with a tile, house.glb, a hidden file, and a secret beside the folder.
fn folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    std::fs::create_dir_all(out.join("city/tiles")).unwrap();
    std::fs::write(out.join("city/tileset.json"), TILESET).unwrap();
    std::fs::write(out.join("city/tiles/0 0.glb"), glb()).unwrap();
    std::fs::write(out.join("house.glb"), glb()).unwrap();
    std::fs::write(out.join(".hidden"), "hidden").unwrap();
    std::fs::write(folder.path().join("secret.txt"), "secret").unwrap();
    folder
}

/// A running server; ended with the test.
struct Running {
    child: Child,
    port: u16,
    said: serde_json::Value,
}

impl Running {
    fn start(path: &Path) -> Self {
        let mut command = sat3d();
        command.args(["view", "--json"]).arg(path).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut text = String::new();
        let mut lines = BufReader::new(child.stdout.take().unwrap());
        while lines.read_line(&mut text).unwrap() > 0 && !text.ends_with("\n}\n") {}
        let said: serde_json::Value = serde_json::from_str(&text).expect(&text);
        let url = said["url"].as_str().unwrap();
        let port = url.strip_prefix("http://127.0.0.1:").unwrap().trim_end_matches('/');
        Self { port: port.parse().unwrap(), child, said }
    }

    /// Sends bytes as they are; the status, head and body of the answer.
    fn raw(&self, request: &str) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).unwrap();
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").expect("a head") + 4;
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head, bytes[end..].to_vec())
    }

    fn ask(&self, method: &str, path: &str, more: &str) -> (u16, String, Vec<u8>) {
        let port = self.port;
        self.raw(&format!(
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n{more}\r\n"
        ))
    }

    fn get(&self, path: &str) -> (u16, String, Vec<u8>) {
        self.ask("GET", path, "")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn the_page_and_the_files_are_served() {
    let folder = folder();
    let server = Running::start(&folder.path().join("out"));
    let paths: Vec<_> =
        server.said["items"].as_array().unwrap().iter().map(|item| &item["path"]).collect();
    assert_eq!(paths, ["city/tileset.json", "house.glb"], "tiles are no items of their own");
    let (status, head, body) = server.get("/");
    assert_eq!(status, 200, "{head}");
    assert!(head.contains("Content-Security-Policy: default-src 'self';"), "{head}");
    assert!(head.contains("Cache-Control: no-store\r\n"), "{head}");
    assert!(String::from_utf8(body).unwrap().contains("viewer.js"));
    let listed: serde_json::Value =
        serde_json::from_slice(&server.get("/contents.json").2).unwrap();
    assert_eq!(listed["items"], server.said["items"]);
    for (path, mime, expected) in [
        ("/data/city/tileset.json", "application/json", TILESET.as_bytes()),
        ("/data/city/tiles/0%200.glb?v=1", "model/gltf-binary", &glb()),
        ("/viewer.js", "text/javascript", include_bytes!("../../viewer/dist/viewer.js")),
        ("/licences.txt", "text/plain", include_bytes!("../../viewer/NOTICE")),
    ] {
        let (status, head, body) = server.get(path);
        assert_eq!(status, 200, "{path}: {head}");
        assert!(head.contains(&format!("Content-Type: {mime}")), "{path}: {head}");
        assert!(body == expected, "{path}");
    }
    let (status, head, body) = server.ask("HEAD", "/data/house.glb", "");
    assert_eq!((status, body.len()), (200, 0));
    assert!(head.contains(&format!("Content-Length: {}\r\n", glb().len())), "{head}");
}

#[test]
fn parts_of_files_are_served() {
    let folder = folder();
    let server = Running::start(&folder.path().join("out"));
    let (status, head, body) = server.ask("GET", "/data/house.glb", "Range: bytes=1-3\r\n");
    assert_eq!((status, &body[..]), (206, &b"lTF"[..]));
    assert!(head.contains(&format!("Content-Range: bytes 1-3/{}\r\n", glb().len())), "{head}");
    let (status, head, _) = server.ask("GET", "/data/house.glb", "Range: bytes=5000-\r\n");
    assert_eq!(status, 416);
    assert!(head.contains(&format!("Content-Range: bytes */{}\r\n", glb().len())), "{head}");
}

#[test]
fn what_lies_outside_is_refused() {
    let folder = folder();
    let out = folder.path().join("out");
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(folder.path(), out.join("up")).unwrap();
        std::os::unix::fs::symlink("../secret.txt", out.join("secret.txt")).unwrap();
        std::os::unix::fs::symlink("house.glb", out.join("same.glb")).unwrap();
    }
    let server = Running::start(&out);
    for path in [
        "/data/../secret.txt",
        "/data/%2e%2e/secret.txt",
        "/data/..%2fsecret.txt",
        "/data/city/../../secret.txt",
        "/data//etc/passwd",
        "/data/%2fetc/passwd",
        "/data/..%5csecret.txt",
        "/data/up/secret.txt",
        "/data/secret.txt",
        "/data/.hidden",
        "/data/city",
        "/data/",
        "/data/house.glb%00",
        "/secret.txt",
        "/data/%ff",
    ] {
        let (status, head, body) = server.get(path);
        assert_eq!(status, 404, "{path}: {head}");
        assert!(!String::from_utf8_lossy(&body).contains("secret\n"), "{path}");
    }
    #[cfg(unix)]
    assert_eq!(server.get("/data/same.glb").0, 200, "links inside the folder are followed");
}

#[test]
fn other_hosts_and_methods_are_refused() {
    let folder = folder();
    let server = Running::start(&folder.path().join("out"));
    let port = server.port;
    for host in [
        format!("Host: evil.example:{port}\r\n"),
        "Host: 127.0.0.1\r\n".to_owned(),
        String::new(),
        format!("Host: 127.0.0.1:{port}\r\nHost: evil.example:{port}\r\n"),
    ] {
        let (status, _, body) = server.raw(&format!("GET /data/house.glb HTTP/1.1\r\n{host}\r\n"));
        assert_eq!(status, 421, "{host}");
        assert!(!body.starts_with(b"glTF"), "{host}");
    }
    for method in ["POST", "PUT", "DELETE", "OPTIONS"] {
        let (status, head, _) = server.ask(method, "/data/house.glb", "");
        assert_eq!(status, 405, "{method}");
        assert!(head.contains("Allow: GET, HEAD\r\n"), "{head}");
    }
    assert_eq!(server.ask("GET", "/", "Content-Length: 3\r\n").0, 400);
    assert_eq!(server.raw("nonsense\r\n\r\n").0, 400);
    let long = format!("X: {}\r\n", "x".repeat(40_000));
    assert_eq!(server.ask("GET", "/", &long).0, 431);
    // It lives on.
    assert_eq!(server.get("/").0, 200);
}

#[test]
fn idle_connections_keep_nobody_out_and_their_number_is_bounded() {
    let folder = folder();
    let server = Running::start(&folder.path().join("out"));
    let idle: Vec<TcpStream> =
        (0..63).map(|_| TcpStream::connect(("127.0.0.1", server.port)).unwrap()).collect();
    assert_eq!(server.get("/").0, 200);
    let more = TcpStream::connect(("127.0.0.1", server.port)).unwrap();
    let mut refused = TcpStream::connect(("127.0.0.1", server.port)).unwrap();
    refused.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let mut head = [0; 12];
    refused.read_exact(&mut head).unwrap();
    assert_eq!(&head, b"HTTP/1.1 503");
    drop((idle, more));
}

#[test]
fn one_mesh_opens_nothing_beside_it() {
    let folder = folder();
    let server = Running::start(&folder.path().join("out/house.glb"));
    assert_eq!(server.get("/data/house.glb").0, 200);
    assert_eq!(server.get("/data/city/tileset.json").0, 404);
}

#[cfg(unix)]
#[test]
fn a_signal_ends_it_with_success() {
    let folder = folder();
    let mut server = Running::start(&folder.path().join("out/city"));
    // A connection that idles does not hold it up.
    let _idle = TcpStream::connect(("127.0.0.1", server.port)).unwrap();
    let kill = Command::new("kill").args(["-INT", &server.child.id().to_string()]).status();
    assert!(kill.unwrap().success());
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    assert!(TcpStream::connect(("127.0.0.1", server.port)).is_err());
}

#[test]
fn bad_input_is_named_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let refusal = |path: &Path| stderr(&run(sat3d().arg("view").arg(path), 2));
    let text = refusal(&at("absent"));
    assert!(text.contains("absent: no such file or folder; give a 3D Tiles folder"), "{text}");
    std::fs::create_dir(at("empty")).unwrap();
    let text = refusal(&at("empty"));
    assert!(text.contains("holds neither a tileset.json nor a .glb file"), "{text}");
    std::fs::write(at("mesh.ply"), "ply\n").unwrap();
    let text = refusal(&at("mesh.ply"));
    assert!(text.contains("PLY and OBJ meshes open in other programs"), "{text}");
    std::fs::write(at("fake.glb"), "not binary glTF at all").unwrap();
    let text = refusal(&at("fake.glb"));
    assert!(text.contains("does not begin like binary glTF 2"), "{text}");
    std::fs::write(at("cut.glb"), &glb()[..30]).unwrap();
    let text = refusal(&at("cut.glb"));
    assert!(text.contains("cut off: 30 of"), "{text}");
    std::fs::create_dir(at("city")).unwrap();
    std::fs::write(at("city/tileset.json"), &TILESET[..40]).unwrap();
    let text = refusal(&at("city"));
    assert!(text.contains("tileset.json: no JSON, so no tileset"), "{text}");
    std::fs::write(at("city/tileset.json"), "{\"asset\": {}}").unwrap();
    let text = refusal(&at("city"));
    assert!(text.contains("JSON without `root`"), "{text}");
}

#[test]
fn a_port_in_use_is_named() {
    let folder = folder();
    let taken = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let out = folder.path().join("out");
    let text = stderr(&run(sat3d().arg("view").arg(out).args(["--port", &port]), 2));
    assert!(text.contains(&format!("port {port} of 127.0.0.1 is in use")), "{text}");
}

/// Every http(s) address in the page: the name of a namespace, which nobody fetches, and no other.
#[test]
fn the_page_names_no_address_on_the_internet() {
    let mut found = Vec::new();
    for text in [
        include_str!("../../viewer/dist/index.html"),
        include_str!("../../viewer/dist/viewer.css"),
        include_str!("../../viewer/dist/viewer.js"),
    ] {
        for scheme in ["http://", "https://", "ws://", "wss://", "\"//", "'//", "`//", "url(//"] {
            for (at, _) in text.match_indices(scheme) {
                let end = text[at..].char_indices().nth(60).map_or(text.len(), |(n, _)| at + n);
                found.push(&text[at..end]);
            }
        }
    }
    found.retain(|address| !address.starts_with("http://www.w3.org/1999/xhtml"));
    assert!(found.is_empty(), "{found:#?}");
    // The test looked at the page and not at an empty file.
    assert!(include_str!("../../viewer/dist/viewer.js").len() > 300_000);
}
