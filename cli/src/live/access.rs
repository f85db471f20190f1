//! Access to the ports that the program serves: checks of host name, origin and token.
//!
//! A browser on this machine runs scripts of any site. A request therefore names its host and, where it has one, its
//! origin, and both must be this server's. Otherwise a site could read through its visitors' browsers (cross-site
//! requests, DNS rebinding). A token distinguishes other clients on the network and other users of this machine.

use std::fs::File;
use std::io::{ErrorKind, Read};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use sha2::{Digest, Sha256};

use crate::files;

/// Random bytes of a token: 128 bits.
const TOKEN_BYTES: usize = 16;
/// Shortest token that a file may hold, characters.
const LEAST_TOKEN: usize = 16;
/// Longest token that a file may hold, characters.
const MOST_TOKEN: usize = 256;
/// Delay of the answer to a wrong token. Only the client that sent it waits.
const WRONG_TOKEN_DELAY: Duration = Duration::from_secs(1);
/// Lifetime of the cookie in the browser, s: 30 days.
const COOKIE_AGE_S: u32 = 30 * 24 * 3600;

/// Options of all ports that are served.
#[derive(clap::Args, Default)]
pub struct Arguments {
    /// Another name by which clients reach the page or the metrics, such as radar.example:8060 behind a proxy
    #[arg(long, value_name = "HOST[:PORT]", value_parser = parse_host)]
    allow_host: Vec<String>,
    /// File with the token that the page and the metrics require, also on this machine. It is made if it is absent, and only its
    /// owner may read it. Without it, a page that the network can reach has a new token at each start
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

/// Refuses what no client names as its host: an address of a page, for example.
fn parse_host(text: &str) -> Result<String, String> {
    match text.is_empty() || text.contains(|letter: char| letter.is_whitespace() || "/?#@".contains(letter)) {
        true => Err("expected HOST or HOST:PORT, without http:// and without a path".to_owned()),
        false => Ok(text.to_owned()),
    }
}

impl Arguments {
    /// Returns whether any of these options is given.
    pub fn is_given(&self) -> bool {
        self.token_file.is_some() || !self.allow_host.is_empty()
    }

    /// Returns whether `--token-file` is given.
    pub fn has_token(&self) -> bool {
        self.token_file.is_some()
    }

    /// Returns whether other hosts are named and no token protects from those who reach them.
    pub fn is_open_to_others(&self) -> bool {
        self.token_file.is_none() && !self.allow_host.is_empty()
    }

    /// Returns the token of `--token-file`, if one is used.
    ///
    /// # Errors
    /// If the file can be neither read nor made, others than its owner may read it, or it holds no token.
    pub fn token(&self) -> anyhow::Result<Option<Token>> {
        self.token_file.as_deref().map(Token::from_file).transpose()
    }
}

/// Secret text that grants access to the ports. It is shown in the page's link and nowhere else.
#[derive(Clone)]
pub struct Token {
    text: String,
    file: Option<PathBuf>,
}

impl Token {
    /// Creates a random token for one run.
    ///
    /// # Errors
    /// If the system gives no random numbers.
    pub fn random() -> anyhow::Result<Self> {
        Ok(Token { text: random_text()?, file: None })
    }

    /// Reads the token from a file; writes a new one there if the file is absent.
    fn from_file(path: &Path) -> anyhow::Result<Self> {
        let text = match std::fs::metadata(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => make_token_file(path)?,
            _ => read_token_file(path)?,
        };
        Ok(Token { text, file: Some(path.to_owned()) })
    }

    pub fn text(&self) -> &str {
        &self.text
    }

    pub fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }
}

fn random_text() -> anyhow::Result<String> {
    let mut bytes = [0u8; TOKEN_BYTES];
    getrandom::fill(&mut bytes).context("the system gives no random numbers for a token")?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

fn make_token_file(path: &Path) -> anyhow::Result<String> {
    let text = random_text()?;
    match files::create_private(path, format!("{text}\n").as_bytes()) {
        // Another process has made it meanwhile.
        Err(error) if error.kind() == ErrorKind::AlreadyExists => return read_token_file(path),
        created => created.with_context(|| format!("cannot make the token file {}", path.display()))?,
    }
    message!("a new token is in {}", path.display());
    Ok(text)
}

fn read_token_file(path: &Path) -> anyhow::Result<String> {
    let cannot = || format!("cannot read the token file {}", path.display());
    // Checked before opening, because opening a pipe would wait for its writer.
    if !std::fs::metadata(path).with_context(cannot)?.is_file() {
        bail!("the token file {} is no regular file", path.display());
    }
    let file = File::open(path).with_context(cannot)?;
    let mode = file.metadata().with_context(cannot)?.permissions().mode();
    ensure!(
        mode & 0o077 == 0,
        "the token file {} has the permissions {:03o}: others than its owner may use it\n\nhint: chmod 600 {0}, and put a new token in \
         it if others have read it",
        path.display(),
        mode & 0o777
    );
    let mut text = String::new();
    file.take(2 * MOST_TOKEN as u64).read_to_string(&mut text).with_context(cannot)?;
    let text = text.trim();
    // Characters that a link and a header can hold unescaped. The token itself is never quoted.
    let is_plain = text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte));
    ensure!(
        is_plain && (LEAST_TOKEN..=MOST_TOKEN).contains(&text.len()),
        "the token file {} holds no token: {LEAST_TOKEN} to {MOST_TOKEN} letters, digits, '-', '.', '_' or '~' are expected\n\nhint: \
         delete the file, and the next start makes one",
        path.display()
    );
    Ok(text.to_owned())
}

/// Reason for refusing a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The request names a host that is not this server.
    Host,
    /// The request comes from a page of another site.
    Origin,
    NoToken,
    WrongToken,
    Body,
}

/// Page that is shown to clients without a token.
const TOKEN_NEEDED: &str = "<!doctype html>
<html lang=\"en\">
<meta charset=\"utf-8\">
<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">
<title>Token needed</title>
<p>A token is needed here. Open the link with ?token= that the program showed when it started.
<p>If you have just opened that link, <a href=\"./\">go on</a>.
<p>Programs send the header: Authorization: Bearer TOKEN
";

impl Refusal {
    /// Builds the response. The response to a wrong token is delayed, so that tokens cannot be tried quickly.
    pub async fn response(self) -> Response {
        if self == Refusal::WrongToken {
            tokio::time::sleep(WRONG_TOKEN_DELAY).await;
        }
        match self {
            Refusal::Host => {
                let why = "this server is not called by that name; --allow-host NAME:PORT gives it one more\n";
                (StatusCode::FORBIDDEN, why).into_response()
            }
            Refusal::Origin => (StatusCode::FORBIDDEN, "another site may not use this server\n").into_response(),
            Refusal::Body => (StatusCode::PAYLOAD_TOO_LARGE, "requests have no body here\n").into_response(),
            Refusal::NoToken | Refusal::WrongToken => {
                let headers: [(HeaderName, &'static str); 2] =
                    [(header::CONTENT_TYPE, "text/html; charset=utf-8"), (header::WWW_AUTHENTICATE, "Bearer")];
                (StatusCode::UNAUTHORIZED, headers, TOKEN_NEEDED).into_response()
            }
        }
    }
}

/// Access policy of one port.
pub struct Access {
    hosts: Hosts,
    login: Option<Login>,
}

/// Secret of a port: its token and the cookie derived from it.
struct Login {
    token: String,
    /// Name of the cookie. Browsers send cookies to every port of a machine, so each port has its own name.
    cookie: String,
    /// Value of the cookie. It is derived from the token, so it survives a restart with the same token and does not
    /// reveal it.
    session: String,
}

/// Parses the address of a port.
///
/// # Errors
/// The text is not an IP address and a port.
pub fn address(text: &str) -> Result<SocketAddr, &'static str> {
    text.parse().map_err(|_| "expected an IP address and a port, such as 127.0.0.1:8060")
}

impl Access {
    /// Creates the policy of a port that is served at `address`. With a token, clients must present it.
    pub fn new(address: SocketAddr, arguments: &Arguments, token: Option<&Token>) -> Self {
        let login = token.map(|token| Login {
            token: token.text.clone(),
            cookie: format!("radome_{}", address.port()),
            session: format!("{:x}", Sha256::digest(format!("radome session of {}", token.text))),
        });
        Access { hosts: Hosts::new(address, &arguments.allow_host), login }
    }

    /// Checks that a request is meant for this server and comes from no other site.
    ///
    /// # Errors
    /// [`Refusal::Host`] or [`Refusal::Origin`].
    pub fn check_source(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or("");
        let host = text(header::HOST).to_ascii_lowercase();
        if !self.hosts.contains(&host) {
            return Err(Refusal::Host);
        }
        // Only browsers send an origin. From another site, it names another host.
        if headers.contains_key(header::ORIGIN) {
            let origin = text(header::ORIGIN).to_ascii_lowercase();
            let origin_host = origin.strip_prefix("http://").or(origin.strip_prefix("https://")).unwrap_or("");
            if origin_host != host {
                return Err(Refusal::Origin);
            }
        }
        Ok(())
    }

    /// Checks that a request contains the token, as `Authorization: Bearer`, or the cookie that it was exchanged for.
    ///
    /// # Errors
    /// [`Refusal::NoToken`] or [`Refusal::WrongToken`].
    pub fn check_token(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        let Some(login) = &self.login else { return Ok(()) };
        let texts = |name: HeaderName| headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
        let bearers = texts(header::AUTHORIZATION).filter_map(|value| {
            let (scheme, token) = value.split_once(' ')?;
            scheme.eq_ignore_ascii_case("bearer").then_some((token.trim(), login.token.as_str()))
        });
        let cookies = texts(header::COOKIE).flat_map(|value| value.split(';')).filter_map(|pair| {
            let (name, value) = pair.trim().split_once('=')?;
            (name == login.cookie).then_some((value, login.session.as_str()))
        });
        let mut refusal = Refusal::NoToken;
        for (given, expected) in bearers.chain(cookies) {
            if is_same(given, expected) {
                return Ok(());
            }
            refusal = Refusal::WrongToken;
        }
        Err(refusal)
    }

    /// Checks the token in the page's link, `/?token=TOKEN`; `None` for other links, or where no token is needed.
    pub fn check_link(&self, uri: &Uri) -> Option<bool> {
        let login = self.login.as_ref().filter(|_| uri.path() == "/")?;
        let given = uri.query()?.split('&').find_map(|pair| pair.strip_prefix("token="))?;
        Some(is_same(given, &login.token))
    }

    /// Response to a correct link: a cookie, and a redirect to the page's address without the token. This keeps the
    /// token out of the address bar and the history.
    pub fn login_response(&self) -> Response {
        let mut response = StatusCode::SEE_OTHER.into_response();
        let headers = response.headers_mut();
        headers.insert(header::LOCATION, HeaderValue::from_static("./"));
        let cookie = self.login.as_ref().and_then(|Login { cookie, session, .. }| {
            let text = format!("{cookie}={session}; Path=/; Max-Age={COOKIE_AGE_S}; HttpOnly; SameSite=Strict");
            HeaderValue::try_from(text).ok()
        });
        if let Some(cookie) = cookie {
            headers.insert(header::SET_COOKIE, cookie);
        }
        response
    }
}

/// Refuses a request with a body, since no request here needs one. The body is not awaited.
///
/// # Errors
/// [`Refusal::Body`].
pub fn check_no_body(headers: &HeaderMap) -> Result<(), Refusal> {
    let has_length = headers.get_all(header::CONTENT_LENGTH).into_iter().any(|length| length != "0");
    if has_length || headers.contains_key(header::TRANSFER_ENCODING) { Err(Refusal::Body) } else { Ok(()) }
}

/// Compares texts in constant time, regardless of the position of a difference.
fn is_same(a: &str, b: &str) -> bool {
    let (a, b) = (Sha256::digest(a), Sha256::digest(b));
    a.iter().zip(b.iter()).fold(0u8, |difference, (a, b)| difference | (a ^ b)) == 0
}

/// Address under which other machines reach a port. If it is served at every address of this machine, this is the
/// address of the network route, else the machine's name.
pub fn reachable(address: SocketAddr) -> String {
    if !address.ip().is_unspecified() {
        return address.to_string();
    }
    // No packet is sent: connecting a datagram socket only looks up the route. The addresses are reserved for
    // documentation.
    let of_route = |from: IpAddr, to: IpAddr| {
        let socket = UdpSocket::bind((from, 0)).ok()?;
        socket.connect((to, 9)).ok()?;
        let ip = socket.local_addr().ok()?.ip();
        (!ip.is_unspecified() && !ip.is_loopback()).then(|| SocketAddr::new(ip, address.port()).to_string())
    };
    let v4 = || of_route(Ipv4Addr::UNSPECIFIED.into(), Ipv4Addr::new(192, 0, 2, 1).into());
    let v6 = || of_route(Ipv6Addr::UNSPECIFIED.into(), Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 1).into());
    let by_name = || host_name().map(|name| format!("{name}:{}", address.port()));
    v4().or_else(|| v6().filter(|_| address.is_ipv6())).or_else(by_name).unwrap_or_else(|| address.to_string())
}

/// Returns the name of this machine, if it has one.
fn host_name() -> Option<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").ok()?;
    Some(name.trim().to_ascii_lowercase()).filter(|name| !name.is_empty())
}

/// Names and addresses under which a port is reached.
struct Hosts {
    port: u16,
    /// Whether the port is reachable from this machine only.
    is_loopback: bool,
    names: Vec<String>,
}

impl Hosts {
    fn new(address: SocketAddr, allowed: &[String]) -> Self {
        let mut names: Vec<String> = allowed.iter().map(|name| name.to_ascii_lowercase()).collect();
        let (port, is_loopback) = (address.port(), address.ip().is_loopback());
        names.push(format!("localhost:{port}"));
        if let Some(name) = host_name().filter(|_| !is_loopback) {
            names.push(format!("{name}:{port}"));
            names.push(format!("{name}.local:{port}"));
        }
        Hosts { port, is_loopback, names }
    }

    /// Returns whether a `Host` in lower case denotes this server: one of its names, or any address. Unlike a name, an
    /// address cannot be rebound, and another machine's address does not lead here.
    fn contains(&self, host: &str) -> bool {
        // Clients omit the default port of HTTP. The colons of an IPv6 address are within brackets.
        let has_port = host.contains(':') && !host.ends_with(']');
        let with_port = if self.port == 80 && !has_port { format!("{host}:80") } else { host.to_owned() };
        if self.names.iter().any(|name| name == host || *name == with_port) {
            return true;
        }
        let Ok(address) = with_port.parse::<SocketAddr>() else { return false };
        address.port() == self.port && (!self.is_loopback || address.ip().is_loopback())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(HeaderName, &str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(name, HeaderValue::from_str(value).expect("a header"));
        }
        headers
    }

    fn protected(token: &str) -> Access {
        let token = Token { text: token.to_owned(), file: None };
        Access::new("0.0.0.0:8060".parse().expect("an address"), &Arguments::default(), Some(&token))
    }

    #[test]
    fn the_link_gives_a_cookie_and_the_cookie_or_the_token_opens() {
        let access = protected("0123456789abcdef");
        let link = |text: &'static str| access.check_link(&Uri::from_static(text));
        assert_eq!(link("/?token=0123456789abcdef"), Some(true));
        assert_eq!(link("/?x=1&token=0123456789abcdef"), Some(true));
        assert_eq!(link("/?token=0123456789abcdeF"), Some(false));
        assert_eq!(link("/?token="), Some(false));
        assert_eq!(link("/"), None);
        assert_eq!(link("/labels.json?token=0123456789abcdef"), None, "only the page's own address");
        let response = access.login_response();
        assert_eq!(response.status(), StatusCode::SEE_OTHER);
        let cookie = response.headers()[header::SET_COOKIE].to_str().expect("text");
        assert!(cookie.starts_with("radome_8060=") && !cookie.contains("0123456789abcdef"), "{cookie}");
        for part in ["HttpOnly", "SameSite=Strict", "Path=/"] {
            assert!(cookie.contains(part), "{cookie}");
        }
        let cookie = cookie.split(';').next().expect("a value");
        let several = format!("theme=dark; {cookie}");
        for right in [
            headers(&[(header::COOKIE, cookie)]),
            headers(&[(header::COOKIE, &several)]),
            headers(&[(header::COOKIE, "a=b"), (header::COOKIE, cookie)]),
            headers(&[(header::AUTHORIZATION, "Bearer 0123456789abcdef")]),
            headers(&[(header::AUTHORIZATION, "bearer 0123456789abcdef")]),
        ] {
            assert_eq!(access.check_token(&right), Ok(()), "{right:?}");
        }
        // The same token after a restart gives the same cookie; another token does not.
        let cookie = headers(&[(header::COOKIE, cookie)]);
        assert_eq!(protected("0123456789abcdef").check_token(&cookie), Ok(()));
        assert_eq!(protected("0123456789abcdeg").check_token(&cookie), Err(Refusal::WrongToken));
    }

    #[test]
    fn a_token_file_is_made_for_its_owner_alone_and_read_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("token");
        let made = Token::from_file(&path).expect("makes it");
        assert_eq!(made.text().len(), 2 * TOKEN_BYTES);
        assert_ne!(made.text(), Token::random().expect("random numbers").text());
        assert_eq!(std::fs::metadata(&path).expect("there").permissions().mode() & 0o777, 0o600);
        assert_eq!(Token::from_file(&path).expect("reads it").text(), made.text());
        for mode in [0o640, 0o604, 0o660, 0o601] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).expect("settable");
            let error = Token::from_file(&path).err().expect("others may use it").to_string();
            assert!(error.contains("chmod 600") && !error.contains(made.text()), "{error}");
        }
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o400)).expect("settable");
        assert!(Token::from_file(&path).is_ok());
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn names_of_other_hosts_are_refused() {
            let local = Hosts::new("127.0.0.1:8060".parse().expect("an address"), &["Radar.example".into()]);
            for host in ["127.0.0.1:8060", "localhost:8060", "[::1]:8060", "radar.example"] {
                assert!(local.contains(host), "{host}");
            }
            for host in [
                "",
                "localhost",
                "localhost:8061",
                "127.0.0.1",
                "127.0.0.1:80600",
                "evil.example:8060",
                "192.168.0.4:8060",
                "localhost.evil.example:8060",
                "127.0.0.1.evil.example:8060",
                "radar.example:8060",
                "[::1]",
                "127.1:8060",
            ] {
                assert!(!local.contains(host), "{host}");
            }
            let public = Hosts::new("0.0.0.0:80".parse().expect("an address"), &[]);
            for host in ["192.168.0.4:80", "192.168.0.4", "[fe80::1]:80"] {
                assert!(public.contains(host), "{host}");
            }
            assert!(!public.contains("evil.example") && !public.contains("evil.example:80"));
        }

        /// On port 80 names and IPv6 addresses were refused, because clients omit that port.
        #[test]
        fn the_default_port_may_be_omitted() {
            let of = |address: &str| Hosts::new(address.parse().expect("an address"), &["Radar.example:80".into()]);
            let (local, public) = (of("127.0.0.1:80"), of("[::]:80"));
            for host in ["localhost", "localhost:80", "radar.example", "radar.example:80", "127.0.0.1", "[::1]"] {
                assert!(local.contains(host) && public.contains(host), "{host}");
            }
            assert!(public.contains("[fe80::1]") && public.contains("192.168.0.4"));
            for host in ["", "localhost:81", "[fe80::1]", "192.168.0.4", "example", "[::1]:81"] {
                assert!(!local.contains(host), "{host}");
            }
        }

        #[test]
        fn anything_but_the_token_is_refused() {
            let access = protected("0123456789abcdef");
            for nothing in [
                headers(&[]),
                headers(&[(header::COOKIE, "radome_8061=0123456789abcdef; radome=x; radome_8060")]),
                headers(&[(header::AUTHORIZATION, "Basic MDEyMzQ1Njc4OWFiY2RlZg==")]),
                headers(&[(header::AUTHORIZATION, "0123456789abcdef")]),
            ] {
                assert_eq!(access.check_token(&nothing), Err(Refusal::NoToken), "{nothing:?}");
            }
            for wrong in [
                headers(&[(header::AUTHORIZATION, "Bearer ")]),
                headers(&[(header::AUTHORIZATION, "Bearer 0123456789abcde")]),
                headers(&[(header::AUTHORIZATION, "Bearer 0123456789abcdef0")]),
                // The value of the cookie is not the token.
                headers(&[(header::COOKIE, "radome_8060=0123456789abcdef")]),
                headers(&[(header::COOKIE, "radome_8060=")]),
            ] {
                assert_eq!(access.check_token(&wrong), Err(Refusal::WrongToken), "{wrong:?}");
            }
        }

        #[test]
        fn bodies_are_refused_and_the_length_zero_is_none() {
            assert_eq!(check_no_body(&headers(&[])), Ok(()));
            assert_eq!(check_no_body(&headers(&[(header::CONTENT_LENGTH, "0")])), Ok(()));
            assert_eq!(check_no_body(&headers(&[(header::CONTENT_LENGTH, "1")])), Err(Refusal::Body));
            assert_eq!(check_no_body(&headers(&[(header::TRANSFER_ENCODING, "chunked")])), Err(Refusal::Body));
        }

        #[test]
        fn files_that_hold_no_token_are_refused_and_never_quoted() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("token");
            for content in [
                "",
                "\n",
                "short-secret",
                "a secret with spaces in it",
                "secret\nsecret\nsecret",
                "\u{fc}secretsecretsecret",
            ] {
                std::fs::write(&path, content).expect("writable");
                std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).expect("settable");
                let error = crate::output::chain(&Token::from_file(&path).err().expect("no token"));
                assert!(error.contains("token") && !error.contains("secret"), "{error}");
            }
            std::fs::write(&path, "s".repeat(10_000)).expect("writable");
            assert!(Token::from_file(&path).is_err());
            assert!(Token::from_file(folder.path()).is_err());
            assert!(Token::from_file(&folder.path().join("nowhere/token")).is_err());
        }
    }
}
