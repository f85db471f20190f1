//! Address and login of the MQTT broker. Passwords come from a file or the environment, never from the command line,
//! and are never shown.

use std::fs::File;
use std::io::Read;
use std::net::Ipv6Addr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use crossbeam::channel::bounded;
use percent_encoding::percent_decode_str;
use rumqttc::v5::MqttOptions;
use rumqttc::{TlsConfiguration, Transport};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;

use crate::exit::{WrongUse, wrong_use};

const GRAMMAR: &str = "\n\nhint: mqtt://HOST, mqtt://USER@HOST:PORT or mqtts://HOST; the password comes from \
                       --mqtt-password-file FILE or RADOME_MQTT_PASSWORD";
/// Environment variables that hold user and password.
pub const USER_VARIABLE: &str = "RADOME_MQTT_USER";
pub const PASSWORD_VARIABLE: &str = "RADOME_MQTT_PASSWORD";
/// Longest password that is read from a file, bytes.
const MOST_PASSWORD_BYTES: u64 = 4096;
/// Time to wait for a password from a pipe.
const PASSWORD_WAIT: Duration = Duration::from_secs(10);
/// Longest packet that is accepted from a broker, bytes. Messages of the subscribed topics have a few bytes.
const MOST_PACKET_BYTES: u32 = 4096;
/// Largest file of certificates, bytes.
const MOST_PEM_BYTES: u64 = 16 << 20;
/// Keep-alive interval of a connection. After one and a half times this, the broker reports the radar as offline.
pub(super) const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// Options that name a broker.
#[derive(clap::Args, Default)]
pub struct BrokerArguments {
    /// MQTT broker, as for Home Assistant: mqtt://[USER@]HOST[:PORT], or mqtts:// with encryption. RADOME_MQTT_USER may name the
    /// user instead
    #[arg(long = "mqtt", id = "mqtt", value_name = "URL")]
    pub url: Option<String>,
    /// File whose first line is the password at the broker; only its owner and group may read it. Without it, the password
    /// is RADOME_MQTT_PASSWORD
    #[arg(long, value_name = "FILE", requires = "mqtt")]
    pub mqtt_password_file: Option<PathBuf>,
    /// Certificates with which the broker is verified, instead of the system's
    #[arg(long, value_name = "FILE.pem", requires = "mqtt")]
    pub mqtt_ca: Option<PathBuf>,
}

impl BrokerArguments {
    /// Returns the broker with its login; `None` where no broker is named.
    ///
    /// # Errors
    /// The address is malformed or holds a password; the password's file cannot be read or others may read it; there is a
    /// password but no user. No error quotes any part of the login.
    pub fn broker(&self) -> anyhow::Result<Option<Broker>> {
        let Some(url) = &self.url else { return Ok(None) };
        let password = match &self.mqtt_password_file {
            Some(path) => Some(read_password(path)?),
            None => variable(PASSWORD_VARIABLE)?.map(Secret),
        };
        Ok(Some(Broker::parse(url, variable(USER_VARIABLE)?, password).map_err(WrongUse)?))
    }

    /// Builds the options of a connection to the broker, without the client's identity and the last will.
    ///
    /// # Errors
    /// The certificates cannot be read, or a file of them is named for a connection that is not encrypted.
    pub fn options(&self, broker: &Broker) -> anyhow::Result<MqttOptions> {
        let mut options = MqttOptions::new("radome", &broker.host, broker.port);
        options.set_keep_alive(KEEP_ALIVE);
        options.set_clean_start(true);
        options.set_connection_timeout(10);
        // MQTT 5 sends this limit to the broker, which then withholds longer packets, including retained ones.
        options.set_max_packet_size(Some(MOST_PACKET_BYTES));
        if let Some(user) = &broker.user {
            options.set_credentials(user, broker.password.as_ref().map_or("", Secret::reveal));
        }
        if broker.is_encrypted {
            let tls = tls(self.mqtt_ca.as_deref())?;
            options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(Arc::new(tls))));
        } else if self.mqtt_ca.is_some() {
            wrong_use!("--mqtt-ca is for connections that are encrypted\n\nhint: --mqtt mqtts://HOST");
        }
        Ok(options)
    }
}

/// Returns an environment variable, if it is set and not empty.
fn variable(name: &str) -> anyhow::Result<Option<String>> {
    match std::env::var_os(name).filter(|value| !value.is_empty()).map(|value| value.into_string()) {
        None => Ok(None),
        Some(Ok(value)) => Ok(Some(value)),
        // The value is not quoted, since it may be a password.
        Some(Err(_)) => bail!("the environment variable {name} is not text in UTF-8"),
    }
}

/// Reads the first line of a file that only its owner and group may read. Waits for a pipe for a few seconds.
fn read_password(path: &Path) -> anyhow::Result<Secret> {
    let (sender, receiver) = bounded(1);
    let file = path.to_owned();
    std::thread::spawn(move || sender.send(read_password_blocking(&file)));
    receiver.recv_timeout(PASSWORD_WAIT).unwrap_or_else(|_| {
        bail!(
            "{}: no password has come for {} s\n\nhint: it is a pipe to which nobody writes, or its disk hangs",
            path.display(),
            PASSWORD_WAIT.as_secs()
        )
    })
}

fn read_password_blocking(path: &Path) -> anyhow::Result<Secret> {
    let context = || format!("cannot read the password in {}", path.display());
    let file = File::open(path).with_context(context)?;
    let mode = file.metadata().with_context(context)?.permissions().mode();
    ensure!(
        mode & 0o007 == 0,
        "{path}: every user of this machine may read or change this password (mode {mode:03o})\n\nhint: chmod 600 {path}",
        path = path.display(),
        mode = mode & 0o777
    );
    let mut text = Vec::new();
    file.take(MOST_PASSWORD_BYTES + 1).read_to_end(&mut text).with_context(context)?;
    if text.len() as u64 > MOST_PASSWORD_BYTES {
        bail!("{}: longer than {MOST_PASSWORD_BYTES} bytes, so it is no file of a password", path.display());
    }
    let Ok(text) = String::from_utf8(text) else { bail!("{}: the password is not text in UTF-8", path.display()) };
    let password = text.lines().next().unwrap_or_default();
    ensure!(!password.is_empty(), "{}: there is no password in its first line", path.display());
    Ok(Secret(password.to_owned()))
}

/// Text that no formatting shows.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// Returns the text itself, which must not appear in errors and logs.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("(secret)")
    }
}

/// Address of a broker, and the login there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broker {
    /// Name or address of the host; IPv6 in brackets.
    pub host: String,
    port: u16,
    is_encrypted: bool,
    pub user: Option<String>,
    pub password: Option<Secret>,
}

/// Formats host and port without the login, for logs.
impl std::fmt::Display for Broker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

impl Broker {
    /// Parses a URL, completed by the file and the environment. A URL that holds a password is refused, since other
    /// users see it in the list of processes. No error quotes the URL, since its malformed part may be a password.
    fn parse(url: &str, user: Option<String>, password: Option<Secret>) -> anyhow::Result<Self> {
        let (is_encrypted, rest) = match url.split_once("://") {
            Some(("mqtt" | "tcp", rest)) => (false, rest),
            Some(("mqtts" | "ssl", rest)) => (true, rest),
            _ => bail!("the broker's address does not begin with mqtt:// or mqtts://{GRAMMAR}"),
        };
        // The host follows the last @, since a password may hold any character.
        let (login, address) = match rest.rsplit_once('@') {
            Some((login, address)) => (Some(login), address),
            None => (None, rest),
        };
        ensure!(
            !login.is_some_and(|login| login.contains(':')),
            "the broker's address holds a password, which other users can read in the list of processes\n\nhint: write it \
             into a file for --mqtt-password-file FILE (chmod 600), or set {PASSWORD_VARIABLE}; --mqtt mqtt://USER@HOST"
        );
        let address = address.strip_suffix('/').unwrap_or(address);
        let default_port = if is_encrypted { 8883 } else { 1883 };
        // An IPv6 address is enclosed in brackets.
        let (host, port) = match address.rsplit_once(':') {
            Some((host, port)) if !port.contains(']') => match port.parse() {
                Ok(port) => (host, port),
                Err(_) => bail!("the port in the broker's address is not a number from 1 to 65535{GRAMMAR}"),
            },
            _ => (address, default_port),
        };
        if !is_host(host) || port == 0 {
            bail!("the broker's address holds no valid host, or port 0, or more than host and port{GRAMMAR}");
        }
        ensure!(
            !is_encrypted || !host.starts_with('['),
            "the certificate of an encrypted broker cannot be verified by an IPv6 address\n\nhint: name the broker by its host name, \
             mqtts://HOST"
        );
        let decode = |text: &str| percent_decode_str(text).decode_utf8().map(|text| text.into_owned());
        let url_user = match login.filter(|login| !login.is_empty()).map(decode) {
            Some(Ok(user)) => Some(user),
            Some(Err(_)) => bail!("the user in the broker's address is not text in UTF-8{GRAMMAR}"),
            None => None,
        };
        let user = url_user.or(user);
        ensure!(user.is_some() || password.is_none(), "there is a password for the broker, but no user{GRAMMAR}");
        Ok(Broker { host: host.to_owned(), port, is_encrypted, user, password })
    }
}

/// Returns whether a text is a host name, an IPv4 address, or an IPv6 address in brackets.
fn is_host(host: &str) -> bool {
    match host.strip_prefix('[').and_then(|host| host.strip_suffix(']')) {
        // A link-local address includes its interface: fe80::1%eth0.
        Some(address) => address.split('%').next().is_some_and(|address| address.parse::<Ipv6Addr>().is_ok()),
        None => !host.is_empty() && host.chars().all(|c| c.is_alphanumeric() || ".-_".contains(c)),
    }
}

fn tls(authorities: Option<&Path>) -> anyhow::Result<rustls::ClientConfig> {
    let mut roots = rustls::RootCertStore::empty();
    match authorities {
        Some(path) => {
            let context = || format!("cannot read the certificates in {}", path.display());
            let pem = radome_files::read(path, MOST_PEM_BYTES).with_context(context)?;
            for certificate in CertificateDer::pem_slice_iter(&pem) {
                roots.add(certificate.with_context(context)?).with_context(context)?;
            }
            ensure!(
                !roots.is_empty(),
                "{} holds no certificate\n\nhint: --mqtt-ca names a file in PEM, which begins with -----BEGIN CERTIFICATE-----",
                path.display()
            );
        }
        None => {
            roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
            ensure!(
                !roots.is_empty(),
                "this system has no certificate to trust the broker by\n\nhint: name its authority's with --mqtt-ca FILE.pem"
            );
        }
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = rustls::ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    Ok(builder.with_root_certificates(roots).with_no_client_auth())
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn parse(url: &str) -> anyhow::Result<Broker> {
        Broker::parse(url, None, None)
    }

    fn secret(text: &str) -> Secret {
        Secret(text.to_owned())
    }

    #[test]
    fn an_address_names_host_port_and_user() {
        let broker = parse("mqtt://ra%40dar@hub.local:1884").expect("parses");
        assert_eq!((broker.host.as_str(), broker.port), ("hub.local", 1884));
        assert_eq!((broker.user.as_deref(), broker.password), (Some("ra@dar"), None));
        assert_eq!(parse("mqtt://hub").expect("parses").port, 1883);
        assert_eq!(parse("mqtts://hub/").expect("parses").port, 8883);
        let broker = parse("mqtt://[::1]:1").expect("parses");
        assert_eq!((broker.host.as_str(), broker.port), ("[::1]", 1));
        assert_eq!(parse("mqtt://[::1]").expect("parses").host, "[::1]");
        assert_eq!(parse("mqtt://u@[fe80::1%25eth0]:1883").expect("parses").user.as_deref(), Some("u"));
    }

    #[test]
    fn file_and_environment_add_the_login_and_nothing_shows_the_password() {
        let with = |url| Broker::parse(url, Some("env".into()), Some(secret("hunter2"))).expect("parses");
        assert_eq!(
            (with("mqtt://hub").user.as_deref(), with("mqtt://u@hub").user.as_deref()),
            (Some("env"), Some("u"))
        );
        let broker = with("mqtt://u@hub");
        assert_eq!(broker.password.as_ref().map(Secret::reveal), Some("hunter2"));
        assert_eq!(broker.to_string(), "hub:1883");
        assert!(!format!("{broker:?} {broker:#?}").contains("hunter2"));
    }

    #[test]
    fn the_password_is_the_first_line_of_a_file_that_others_may_not_read() {
        let mut file = tempfile::NamedTempFile::new().expect("a file");
        let mode = |mode| std::fs::set_permissions(file.path(), PermissionsExt::from_mode(mode)).expect("settable");
        let read = || read_password(file.path()).map_err(|error| format!("{error:#}"));
        assert!(read().expect_err("empty").contains("no password"));
        file.as_file().write_all("hünter 2\r\nof the radar\n".as_bytes()).expect("writable");
        for (bits, is_taken) in
            [(0o600, true), (0o400, true), (0o640, true), (0o644, false), (0o606, false), (0o602, false)]
        {
            mode(bits);
            match read() {
                Ok(password) => assert!(is_taken && password.reveal() == "hünter 2", "{bits:o}"),
                Err(said) => {
                    assert!(!is_taken && said.contains("chmod 600") && !said.contains("nter"), "{bits:o}: {said}")
                }
            }
        }
        mode(0o600);
        file.write_all(&[0xff]).expect("writable");
        assert!(read_password(file.path()).is_err_and(|error| !format!("{error:#} {error:?}").contains("nter")));
        file.write_all(&[b'x'; 5000]).expect("writable");
        assert!(read_password(file.path()).is_err_and(|error| format!("{error}").contains("longer")));
        assert!(read_password(Path::new("/no/such/file")).is_err_and(|e| format!("{e:#}").contains("/no/such/file")));
    }

    /// Regression test: the error of a file without a certificate did not name the file.
    #[test]
    fn a_file_without_a_certificate_is_named() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let error = tls(Some(file.path())).expect_err("no certificate");
        assert!(error.to_string().starts_with(&format!("{} holds no certificate", file.path().display())), "{error}");
    }

    mod hard_cases {
        use proptest::prelude::*;

        use super::*;

        #[test]
        fn an_invalid_address_is_refused_with_a_hint() {
            for url in [
                "",
                "hub",
                "http://hub",
                "mqtt://",
                "mqtt://hub:0",
                "mqtt://hub:x",
                "mqtt://hub:99999",
                "mqtt://hub/a/b",
                "mqtt://u@",
                "mqtt://u@hub:",
                "mqtt://%ff@hub",
                "mqtt://hub?x=1",
                "mqtt://::1",
                "mqtt://[::1",
                "mqtt://[hub]:1",
                "mqtt://[::1]x:1",
                "mqtt://a hub",
                // The TLS library takes no address in brackets.
                "mqtts://[::1]",
                "mqtts://[fe80::1]:8883",
            ] {
                let Err(error) = parse(url) else { panic!("{url} was taken") };
                let said = format!("{error:#}");
                assert!(said.contains("hint:"), "{url}: {said}");
            }
            assert!(Broker::parse("mqtt://hub", None, Some(secret("p"))).is_err());
        }

        proptest! {
            /// A password in an address is refused and not quoted, whether the address is well formed or not.
            #[test]
            fn a_password_in_an_address_is_neither_accepted_nor_quoted(
                scheme in prop::sample::select(vec!["mqtt://", "mqtts://", "ssl://", "http://", "mqtt:", ""]),
                user in "[a-z%:@]{0,6}",
                inner in "[ -~äé€]{0,12}",
                between in prop::sample::select(vec!["@", "@@", ""]),
                host in prop::sample::select(vec!["hub", "hub:1883", "[::1]", "[fe80::1]:8883", "::1", "hub/x", "hub:x", ""]),
            ) {
                let password = format!("hunter{inner}2hunter");
                let url = format!("{scheme}{user}:{password}{between}{host}");
                match parse(&url) {
                    Ok(broker) => prop_assert!(false, "{url} was taken as {broker:?}"),
                    Err(error) => {
                        let said = format!("{error:#} {error:?}");
                        prop_assert!(!said.contains("hunter"), "{url}: {said}");
                    }
                }
            }
        }
    }
}
