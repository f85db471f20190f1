//! Where the MQTT broker is, and how to speak to it.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use percent_encoding::percent_decode_str;
use rumqttc::v5::MqttOptions;
use rumqttc::{TlsConfiguration, Transport};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;

const GRAMMAR: &str =
    "\n\nhint: mqtt://HOST, mqtt://USER@HOST:PORT or mqtts://HOST; the password in RADOME_MQTT_PASSWORD";
/// Longest packet that is taken from a broker: what is subscribed to has messages of a few bytes.
const MOST_PACKET_BYTES: u32 = 4096;
/// How long a silent connection lives; the broker says that the radar is gone after one and a half times this.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// A broker's address and who to be there.
#[derive(Clone, PartialEq, Eq)]
pub struct Broker {
    host: String,
    port: u16,
    is_encrypted: bool,
    user: Option<String>,
    password: Option<String>,
}

/// Without the password: this goes to logs.
impl std::fmt::Display for Broker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

impl Broker {
    /// From a URL and what the environment adds to it.
    pub fn parse(url: &str) -> anyhow::Result<Self> {
        let set = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        Self::parse_with(url, set("RADOME_MQTT_USER"), set("RADOME_MQTT_PASSWORD"))
    }

    fn parse_with(url: &str, user: Option<String>, password: Option<String>) -> anyhow::Result<Self> {
        let (is_encrypted, rest) = match url.split_once("://") {
            Some(("mqtt" | "tcp", rest)) => (false, rest),
            Some(("mqtts" | "ssl", rest)) => (true, rest),
            Some((scheme, _)) => bail!("{scheme}:// is no way to a broker that this program knows{GRAMMAR}"),
            None => bail!("the broker's address lacks mqtt:// or mqtts:// in front{GRAMMAR}"),
        };
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let (login, address) = match rest.rsplit_once('@') {
            Some((login, address)) => (Some(login), address),
            None => (None, rest),
        };
        if address.contains(['/', '?', '#']) {
            bail!("a broker's address ends with its port; a path means nothing to it{GRAMMAR}");
        }
        let default_port = if is_encrypted { 8883 } else { 1883 };
        // An address of IP version 6 stands in brackets.
        let (host, port) = match address.rsplit_once(':') {
            Some((host, port)) if !port.contains(']') => {
                let port = port.parse().with_context(|| format!("`{port}` is no port{GRAMMAR}"))?;
                (host, port)
            }
            _ => (address, default_port),
        };
        if host.is_empty() || port == 0 {
            bail!("the broker's address names no host or port 0{GRAMMAR}");
        }
        let decode = |text: &str| -> anyhow::Result<String> {
            Ok(percent_decode_str(text).decode_utf8().context("the login is not text in UTF-8")?.into_owned())
        };
        let (url_user, url_password) = match login.map(|login| login.split_once(':').unwrap_or((login, ""))) {
            Some((user, password)) => (Some(decode(user)?), Some(decode(password)?).filter(|p| !p.is_empty())),
            None => (None, None),
        };
        let (user, password) = (url_user.or(user), url_password.or(password));
        if user.is_none() && password.is_some() {
            bail!("a password for the broker, but no user{GRAMMAR}");
        }
        Ok(Broker { host: host.to_owned(), port, is_encrypted, user, password })
    }

    /// What a connection needs to know, less the last will. `authorities` is a file of certificates to trust in place of the
    /// system's.
    pub fn options(&self, client_id: &str, authorities: Option<&Path>) -> anyhow::Result<MqttOptions> {
        let mut options = MqttOptions::new(client_id, &self.host, self.port);
        options.set_keep_alive(KEEP_ALIVE);
        options.set_clean_start(true);
        options.set_connection_timeout(10);
        // Version 5 of the protocol lets the broker know: it keeps longer ones to itself, also those that it retains.
        options.set_max_packet_size(Some(MOST_PACKET_BYTES));
        if let Some(user) = &self.user {
            options.set_credentials(user, self.password.as_deref().unwrap_or(""));
        }
        if self.is_encrypted {
            options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(Arc::new(tls(authorities)?))));
        } else if authorities.is_some() {
            bail!("--mqtt-ca is for connections that are encrypted\n\nhint: --mqtt mqtts://HOST");
        }
        Ok(options)
    }
}

fn tls(authorities: Option<&Path>) -> anyhow::Result<rustls::ClientConfig> {
    let mut roots = rustls::RootCertStore::empty();
    match authorities {
        Some(path) => {
            let named = || format!("cannot read the certificates in {}", path.display());
            for certificate in CertificateDer::pem_file_iter(path).with_context(named)? {
                roots.add(certificate.with_context(named)?).with_context(named)?;
            }
        }
        None => {
            roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
        }
    }
    if roots.is_empty() {
        bail!("there is no certificate to trust the broker by\n\nhint: name its authority's with --mqtt-ca FILE.pem");
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = rustls::ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    Ok(builder.with_root_certificates(roots).with_no_client_auth())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(url: &str) -> anyhow::Result<Broker> {
        Broker::parse_with(url, None, None)
    }

    #[test]
    fn an_address_names_host_port_and_login() {
        let broker = parse("mqtt://radar:p%40ss%3A1@hub.local:1884").expect("parses");
        assert_eq!((broker.host.as_str(), broker.port), ("hub.local", 1884));
        assert_eq!((broker.user.as_deref(), broker.password.as_deref()), (Some("radar"), Some("p@ss:1")));
        assert_eq!(parse("mqtt://hub").expect("parses").port, 1883);
        assert_eq!(parse("mqtts://hub/").expect("parses").port, 8883);
        let broker = parse("mqtt://[::1]:1").expect("parses");
        assert_eq!((broker.host.as_str(), broker.port), ("[::1]", 1));
        assert_eq!(parse("mqtt://[::1]").expect("parses").host, "[::1]");
    }

    #[test]
    fn the_environment_adds_what_the_address_lacks_and_logs_show_no_password() {
        let with = |url| Broker::parse_with(url, Some("env".into()), Some("secret".into())).expect("parses");
        assert_eq!(
            (with("mqtt://hub").user.as_deref(), with("mqtt://u@hub").user.as_deref()),
            (Some("env"), Some("u"))
        );
        assert_eq!(with("mqtt://u:p@hub").password.as_deref(), Some("p"));
        assert_eq!(with("mqtt://u@hub").to_string(), "hub:1883");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn what_is_no_address_is_refused_with_a_hint() {
            for url in [
                "",
                "hub",
                "http://hub",
                "mqtt://",
                "mqtt://hub:0",
                "mqtt://hub:x",
                "mqtt://hub:99999",
                "mqtt://hub/a/b",
                "mqtt://u:p@",
                "mqtt://%ff@hub",
                "mqtt://hub?x=1",
            ] {
                let Err(error) = parse(url) else { panic!("{url} was taken") };
                let said = format!("{error:#}");
                assert!(said.contains("hint:") || url.contains("%ff"), "{url}: {said}");
            }
            assert!(Broker::parse_with("mqtt://hub", None, Some("p".into())).is_err());
        }
    }
}
