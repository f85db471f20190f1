//! HTTP server of the page and of the metrics: one request per connection, deadlines for its parts, and limits so that
//! many slow clients cannot block others.
//!
//! From the connection's start, a client has [`Limits::head`] until its request is complete, however often it sends a
//! byte. It has [`Limits::request`] until the response is written. At the maximum number of connections, a new one
//! replaces the oldest, and one that was not admitted before one that was. A connection that becomes a WebSocket leaves
//! these limits; the handler of the upgrade counts those.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::Response;
use axum::{Router, middleware};
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::AbortHandle;

use crate::panics::lock;

/// Longest request line and headers, bytes. Browsers send the cookies of all programs on the same machine.
const MOST_HEAD_BYTES: usize = 16 * 1024;
const MOST_HEADERS: usize = 64;
/// Pause after a connection could not be accepted. If file descriptors have run out, others must close first.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Largest number of simultaneous connections.
    pub connections: usize,
    /// Largest number of simultaneous connections from one network address. Programs on this machine share
    /// [`connections`](Self::connections).
    pub per_address: usize,
    /// Time from the connection's start until the request's head is complete.
    pub head: Duration,
    /// Time from the connection's start until the response is written.
    pub request: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        let (head, request) = (Duration::from_secs(5), Duration::from_secs(20));
        Limits { connections: 128, per_address: 32, head, request }
    }
}

/// Reason why a connection ended without a response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The request was replaced by a newer one.
    Replaced,
    /// The request was malformed, too long or too slow, or its client went away.
    Failed,
}

/// Client of a request; handlers find it among the request's extensions.
#[derive(Debug, Clone)]
pub struct Client {
    pub address: SocketAddr,
    admitted: Arc<AtomicBool>,
}

impl Client {
    /// Marks the connection as admitted: its request passed the checks.
    pub fn admit(&self) {
        self.admitted.store(true, Ordering::Relaxed);
    }

    fn is_admitted(&self) -> bool {
        self.admitted.load(Ordering::Relaxed)
    }
}

/// Serves until the future is dropped; reports connections that end without a response to `on_event`.
pub async fn serve(
    listener: TcpListener,
    router: Router,
    limits: Limits,
    on_event: impl Fn(Event) + Send + Sync + 'static,
) {
    let router = router.layer(middleware::map_response(close_after_response));
    let connections = Mutex::default();
    let server = Arc::new(Server { limits, connections, on_event: Box::new(on_event) });
    loop {
        match listener.accept().await {
            Ok((stream, address)) => server.start(stream, address, &router),
            Err(error) => {
                tracing::debug!("cannot accept a connection: {error}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Closes the connection after its first response, so that idle clients occupy no connection.
async fn close_after_response(mut response: Response) -> Response {
    if response.status() != StatusCode::SWITCHING_PROTOCOLS {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

struct Server {
    limits: Limits,
    connections: Mutex<Connections>,
    on_event: Box<dyn Fn(Event) + Send + Sync>,
}

/// Connections without a response, oldest first.
#[derive(Default)]
struct Connections {
    open: Vec<Connection>,
    next_id: u64,
}

struct Connection {
    id: u64,
    /// Key that [`Limits::per_address`] counts by; `None` for programs on this machine.
    network: Option<IpAddr>,
    client: Client,
    task: AbortHandle,
}

impl Server {
    fn start(self: &Arc<Self>, stream: TcpStream, address: SocketAddr, router: &Router) {
        let _ = stream.set_nodelay(true);
        let client = Client { address, admitted: Arc::default() };
        let service = service_fn({
            let (router, client) = (TowerToHyperService::new(router.clone()), client.clone());
            move |mut request: Request<Incoming>| {
                request.extensions_mut().insert(client.clone());
                router.call(request)
            }
        });
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.limits.head)
            .max_buf_size(MOST_HEAD_BYTES)
            .max_headers(MOST_HEADERS)
            .serve_connection(TokioIo::new(stream), service)
            .with_upgrades();
        let network = network_of(address.ip());
        let mut connections = lock(&self.connections);
        let replaced = connections.make_room(&self.limits, network);
        let id = connections.next_id;
        connections.next_id += 1;
        let guard = ConnectionGuard { server: self.clone(), id };
        let task = tokio::spawn(async move {
            let outcome = tokio::time::timeout(guard.server.limits.request, connection).await;
            if !matches!(outcome, Ok(Ok(()))) {
                (guard.server.on_event)(Event::Failed);
            }
        });
        connections.open.push(Connection { id, network, client, task: task.abort_handle() });
        drop(connections);
        if let Some(replaced) = replaced {
            replaced.task.abort();
            (self.on_event)(Event::Replaced);
        }
    }
}

/// Guard that removes a connection from the list when its task ends for any reason.
struct ConnectionGuard {
    server: Arc<Server>,
    id: u64,
}

impl Drop for ConnectionGuard {
    fn drop(&mut self) {
        lock(&self.server.connections).open.retain(|connection| connection.id != self.id);
    }
}

impl Connections {
    /// Removes and returns the connection that a new one from `network` replaces, if there are too many.
    fn make_room(&mut self, limits: &Limits, network: Option<IpAddr>) -> Option<Connection> {
        let of_network = self.open.iter().filter(|connection| connection.network == network).count();
        let is_network_full = network.is_some() && of_network >= limits.per_address;
        if !is_network_full && self.open.len() < limits.connections {
            return None;
        }
        // If one address has too many connections, a new one replaces one of its own.
        let is_replaceable = |connection: &Connection| !is_network_full || connection.network == network;
        let not_admitted =
            self.open.iter().position(|connection| is_replaceable(connection) && !connection.client.is_admitted());
        let replaced = not_admitted.or_else(|| self.open.iter().position(is_replaceable))?;
        Some(self.open.remove(replaced))
    }
}

/// Returns the network that counts as one client: an IPv4 address, or an IPv6 network of 64 bits. `None` for this
/// machine.
fn network_of(address: IpAddr) -> Option<IpAddr> {
    match address.to_canonical() {
        address if address.is_loopback() => None,
        IpAddr::V6(address) => Some(Ipv6Addr::from(u128::from(address) >> 64 << 64).into()),
        address => Some(address),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};
    use std::sync::mpsc;
    use std::time::Instant;

    use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
    use axum::routing::get;

    /// Timeout far above the duration of any operation on any machine.
    const PATIENCE: Duration = Duration::from_secs(60);
    /// Size above the kernel's buffers for a client that does not read, bytes.
    const LARGE_BYTES: usize = 64 << 20;

    struct Running {
        _runtime: tokio::runtime::Runtime,
        address: SocketAddr,
        events: mpsc::Receiver<Event>,
    }

    fn start(limits: Limits) -> Running {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("a runtime");
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).expect("a port");
        let address = listener.local_addr().expect("bound");
        let (sender, events) = mpsc::channel();
        let router = Router::new()
            .route("/", get(|| async { "answered" }))
            .route("/large", get(|| async { vec![b'x'; LARGE_BYTES] }))
            .route("/socket", get(|upgrade: WebSocketUpgrade| async move { upgrade.on_upgrade(speak_late) }));
        runtime.spawn(serve(listener, router, limits, move |event| {
            let _ = sender.send(event);
        }));
        Running { _runtime: runtime, address, events }
    }

    /// Sends one message after the request's deadline.
    async fn speak_late(mut socket: WebSocket) {
        tokio::time::sleep(Duration::from_secs(1)).await;
        let _ = socket.send(Message::Text("still here".into())).await;
    }

    impl Running {
        fn connect(&self) -> std::net::TcpStream {
            let stream = std::net::TcpStream::connect(self.address).expect("a connection");
            stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
            stream
        }

        fn get(&self) -> String {
            let mut stream = self.connect();
            let mut answer = String::new();
            let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n");
            let _ = stream.read_to_string(&mut answer);
            answer
        }
    }

    #[test]
    fn a_connection_is_closed_after_its_answer() {
        let server = start(Limits::default());
        let answer = server.get();
        assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("answered"), "{answer}");
        assert!(answer.to_ascii_lowercase().contains("connection: close"), "{answer}");
    }

    #[test]
    fn a_websocket_outlives_the_deadline_of_its_request() {
        let server = start(Limits { request: Duration::from_millis(500), ..Limits::default() });
        let mut stream = server.connect();
        let request = "GET /socket HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
                       Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
        stream.write_all(request.as_bytes()).expect("sent");
        let (mut heard, mut bytes) = (Vec::new(), [0; 4096]);
        while !heard.ends_with(b"still here") {
            let length = stream.read(&mut bytes).expect("bytes in time");
            assert!(length > 0, "closed after {}", String::from_utf8_lossy(&heard));
            heard.extend_from_slice(&bytes[..length]);
        }
        let head = String::from_utf8_lossy(&heard).to_ascii_lowercase();
        assert!(head.starts_with("http/1.1 101") && !head.contains("connection: close"), "{head}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_head_that_comes_byte_by_byte_is_abandoned() {
            let server = start(Limits { head: Duration::from_millis(300), ..Limits::default() });
            let mut stream = server.connect();
            let start = Instant::now();
            let ended = loop {
                assert!(start.elapsed() < PATIENCE, "still open");
                // Bytes arrive faster than the deadline. A deadline for silence would be renewed by each of them.
                if stream.write_all(b"G").is_err() {
                    break server.events.recv_timeout(PATIENCE);
                }
                if let Ok(event) = server.events.recv_timeout(Duration::from_millis(20)) {
                    break Ok(event);
                }
            };
            assert_eq!(ended, Ok(Event::Failed));
        }

        #[test]
        fn a_client_that_does_not_read_its_response_is_abandoned() {
            let server = start(Limits { request: Duration::from_secs(1), ..Limits::default() });
            let mut stream = server.connect();
            stream.write_all(b"GET /large HTTP/1.1\r\nHost: x\r\n\r\n").expect("sent");
            assert_eq!(server.events.recv_timeout(PATIENCE), Ok(Event::Failed));
            let mut answer = Vec::new();
            let _ = stream.read_to_end(&mut answer);
            assert!(answer.len() < LARGE_BYTES, "the whole answer of {} bytes", answer.len());
        }

        #[test]
        fn silent_connections_are_closed_for_new_ones() {
            let server = start(Limits { connections: 4, head: PATIENCE, request: PATIENCE, ..Limits::default() });
            let silent: Vec<_> = (0..40).map(|_| server.connect()).collect();
            for _ in 0..3 {
                let answer = server.get();
                assert!(answer.ends_with("answered"), "{answer:?}");
            }
            let replaced = server.events.try_iter().filter(|event| *event == Event::Replaced).count();
            assert!(replaced >= 36, "{replaced} of 40 were replaced");
            drop(silent);
        }

        #[test]
        fn an_address_with_too_many_connections_replaces_its_own_and_those_not_admitted_first() {
            let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
            let task = runtime.spawn(async {}).abort_handle();
            let [here, near, far] =
                ["127.0.0.1", "192.0.2.1", "198.51.100.7"].map(|text| network_of(text.parse().expect("an address")));
            assert_eq!(here, None);
            let [a, b, c] = ["2001:db8::1", "2001:db8::2:0:0:9", "2001:db8:0:1::1"]
                .map(|text| network_of(text.parse().expect("an address")));
            assert!(a == b && a != c, "{a:?}, {b:?}, {c:?}");

            let limits = Limits { connections: 6, per_address: 2, ..Limits::default() };
            let mut connections = Connections::default();
            let add = |connections: &mut Connections, network: Option<IpAddr>, is_admitted: bool| {
                let replaced = connections.make_room(&limits, network).map(|connection| connection.id);
                let id = connections.next_id;
                connections.next_id += 1;
                let address = "192.0.2.9:9".parse().expect("an address");
                let client = Client { address, admitted: Arc::new(AtomicBool::new(is_admitted)) };
                connections.open.push(Connection { id, network, client, task: task.clone() });
                replaced
            };
            assert_eq!(add(&mut connections, far, true), None);
            assert_eq!(add(&mut connections, near, true), None);
            assert_eq!(add(&mut connections, near, false), None);
            // Connections 1 and 2 come from the same address; 1 is older, but admitted.
            assert_eq!(add(&mut connections, near, false), Some(2));
            assert_eq!(add(&mut connections, near, true), Some(3));
            assert_eq!(add(&mut connections, near, true), Some(1));
            for _ in 0..3 {
                assert_eq!(add(&mut connections, here, true), None);
            }
            // All are admitted, so the oldest of all is replaced.
            assert_eq!(add(&mut connections, here, false), Some(0));
            assert_eq!(connections.open.len(), 6);
        }
    }
}
