//! MQTT client: publishes answers to a broker, and announces the radar to Home Assistant. Failures of the broker do not
//! affect the classification of frames.

use std::io::ErrorKind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use radome_dsp::Occupancy;
use rumqttc::v5::mqttbytes::v5::{LastWill, Packet, PubAckReason, Publish, SubscribeReasonCode};
use rumqttc::v5::mqttbytes::{Error as PacketError, QoS};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions, StateError, TlsError};
use rumqttc::{Outgoing, Transport};
use tokio::sync::{mpsc, watch};

use super::broker::{Broker, KEEP_ALIVE};
use super::discovery::{Device, state};
use super::latest::{Latest, count};
use super::report_buffer::{Report, ReportSender};

/// Interval between repeated messages; a third of the hub's expiry time.
const HEARTBEAT: Duration = Duration::from_secs(10);
/// Interval of the checks for an outage of answers, and least time between two announcements to the hub.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// First and longest delay before the broker is tried again.
const RETRY_DELAYS: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(15)];
/// Duration above which a connection counts as good.
const GOOD_CONNECTION: Duration = Duration::from_secs(30);
/// Longest time that the broker may take to close.
const CLOSING_TIME: Duration = Duration::from_secs(2);

/// Options of a connection.
pub struct Mqtt {
    pub broker: Broker,
    /// Address, login and limits.
    pub options: MqttOptions,
    pub device: Device,
    pub latest: Arc<Latest>,
    /// Destination of reports of wrong answers.
    pub reports: Option<ReportSender>,
}

/// Event of the connection to the broker.
#[derive(Clone, Copy)]
enum BrokerEvent {
    Connected,
    Lost,
    HubOnline,
    /// The hub goes offline; its copy of the discovery is retained.
    HubOffline,
    /// A user reports a wrong answer, with the correct class.
    Report(Occupancy),
}

impl Mqtt {
    /// Publishes until `stop` is set, regardless of the state of the connection.
    pub async fn run(mut self, mut stop: watch::Receiver<bool>) {
        let will = LastWill::new(self.device.availability_topic(), "offline", QoS::AtLeastOnce, true, None);
        self.options.set_last_will(will);
        while !*stop.borrow() {
            let (client, event_loop) = AsyncClient::new(self.options.clone(), 64);
            let (sender, mut events) = mpsc::channel(16);
            let listener = Listener {
                broker: self.broker.clone(),
                device: self.device.clone(),
                latest: self.latest.clone(),
                sender,
            };
            // A separate task: if a packet makes the protocol library panic, only that task ends.
            let mut connection = tokio::spawn(listener.listen(event_loop));
            let mut publisher = Publisher {
                mqtt: &self,
                client,
                published_online: None,
                last_announcement: None,
                needs_announcement: false,
                has_warned: AtomicBool::new(false),
            };
            tokio::select! {
                () = publisher.publish_until_stopped(&mut events, &mut stop) => {}
                _ = &mut connection => {
                    self.latest.counters.mqtt_connected.store(false, Ordering::Relaxed);
                    tracing::error!("the connection to the MQTT broker {} ended unexpectedly; trying again", self.broker);
                    tokio::time::sleep(RETRY_DELAYS[1]).await;
                    continue;
                }
            }
            if self.latest.counters.mqtt_connected.swap(false, Ordering::Relaxed) {
                let _ = tokio::time::timeout(CLOSING_TIME, &mut connection).await;
            }
            connection.abort();
        }
    }
}

/// Connects to a broker, logs in, and leaves again.
///
/// # Errors
/// The cause, in words.
pub async fn log_in(options: MqttOptions) -> Result<(), String> {
    let (client, mut event_loop) = AsyncClient::new(options, 8);
    let is_encrypted = is_encrypted(&event_loop);
    loop {
        match event_loop.poll().await {
            Ok(Event::Incoming(Packet::ConnAck(_))) => {
                let _ = client.disconnect().await;
            }
            Ok(Event::Outgoing(Outgoing::Disconnect)) => return Ok(()),
            Ok(_) => {}
            Err(error) => return Err(describe_error(&error, false, is_encrypted)),
        }
    }
}

fn is_encrypted(event_loop: &EventLoop) -> bool {
    !matches!(event_loop.options.transport(), Transport::Tcp)
}

/// Recent closings of the connection by the broker. Two clients with one name disconnect each other repeatedly.
#[derive(Default)]
struct Closings {
    times: Vec<Instant>,
    is_reported: bool,
}

impl Closings {
    /// Notes a closing; returns true once, at the third within a minute.
    fn add_and_check(&mut self) -> bool {
        let now = Instant::now();
        self.times.retain(|time| now.duration_since(*time) < Duration::from_secs(60));
        self.times.push(now);
        self.times.len() >= 3 && !std::mem::replace(&mut self.is_reported, true)
    }
}

/// Runs the connection, and passes its events to the [`Publisher`].
struct Listener {
    broker: Broker,
    device: Device,
    latest: Arc<Latest>,
    sender: mpsc::Sender<BrokerEvent>,
}

impl Listener {
    async fn listen(self, mut event_loop: EventLoop) {
        let counters = &self.latest.counters;
        let [first_wait, longest_wait] = RETRY_DELAYS;
        let mut wait = first_wait;
        let mut since: Option<Instant> = None;
        let mut closings = Closings::default();
        let mut last_description = String::new();
        let mut reported_rejections = Vec::new();
        let is_encrypted = is_encrypted(&event_loop);
        loop {
            match event_loop.poll().await {
                Ok(Event::Incoming(Packet::ConnAck(_))) => {
                    // A broker may ask for no keep-alive. The library would then send pings without a pause.
                    if event_loop.options.keep_alive().is_zero() {
                        event_loop.options.set_keep_alive(KEEP_ALIVE);
                    }
                    since = Some(Instant::now());
                    last_description.clear();
                    reported_rejections.clear();
                    counters.mqtt_connected.store(true, Ordering::Relaxed);
                    count(&counters.mqtt_connections);
                    message!("MQTT broker {}: connected; answers go to {}", self.broker, self.device.state_topic());
                    let _ = self.sender.send(BrokerEvent::Connected).await;
                }
                Ok(Event::Incoming(Packet::Publish(message))) => match self.parse_message(&message) {
                    Some(event) if self.sender.try_send(event).is_ok() => {}
                    _ => count(&counters.mqtt_refused),
                },
                Ok(Event::Incoming(packet)) => {
                    for rejection in rejections(&packet) {
                        count(&counters.mqtt_rejected);
                        if !reported_rejections.contains(&rejection) {
                            self.warn_of_rejection(&rejection);
                            reported_rejections.push(rejection);
                        }
                    }
                }
                Ok(Event::Outgoing(Outgoing::Disconnect)) => return,
                Ok(Event::Outgoing(_)) => {}
                Err(error) => {
                    counters.mqtt_connected.store(false, Ordering::Relaxed);
                    let description = describe_error(&error, since.is_some(), is_encrypted);
                    if let Some(since) = since.take() {
                        if since.elapsed() > GOOD_CONNECTION {
                            wait = first_wait;
                        }
                        if !self.device.has_uuid && is_closing(&error) && closings.add_and_check() {
                            self.warn_of_name_conflict();
                        }
                    }
                    if is_malformed(&error) {
                        count(&counters.mqtt_refused);
                    }
                    // Each kind of error is reported once.
                    if description != last_description {
                        tracing::warn!(
                            "MQTT broker {}: {description}; trying again, frames are judged meanwhile",
                            self.broker
                        );
                        last_description = description;
                    }
                    let _ = self.sender.send(BrokerEvent::Lost).await;
                    tokio::time::sleep(wait).await;
                    wait = (2 * wait).min(longest_wait);
                }
            }
        }
    }

    fn warn_of_name_conflict(&self) {
        tracing::warn!(
            "MQTT broker {}: it ends each connection; another radar of the same name may be connected there: give each a \
             name of its own with --mqtt-name",
            self.broker
        );
    }

    fn warn_of_rejection(&self, rejection: &str) {
        tracing::warn!(
            "MQTT broker {}: it rejects {rejection}; its user needs to write {}, {} and {}, and to read {}",
            self.broker,
            self.device.discovery_topic(),
            self.device.availability_topic(),
            self.device.state_topic(),
            self.device.subscribed_topics().join(" and ")
        );
    }

    /// Parses a message; `None` if it is malformed.
    fn parse_message(&self, message: &Publish) -> Option<BrokerEvent> {
        let topic = message.topic.as_ref();
        let text = std::str::from_utf8(&message.payload).ok()?.trim();
        if topic == self.device.hub_topic().as_bytes() {
            return match text {
                "online" => Some(BrokerEvent::HubOnline),
                "offline" => Some(BrokerEvent::HubOffline),
                _ => None,
            };
        }
        let is_report = self.device.report_topic().is_some_and(|report| topic == report.as_bytes());
        // A retained report refers to an earlier run.
        (is_report && !message.retain).then(|| Occupancy::from_name(text).map(BrokerEvent::Report)).flatten()
    }
}

/// Publications and subscriptions that the broker rejects with this answer, each with its reason.
fn rejections(packet: &Packet) -> Vec<String> {
    match packet {
        Packet::PubAck(answer) => match answer.reason {
            PubAckReason::Success | PubAckReason::NoMatchingSubscribers => Vec::new(),
            reason => vec![format!("what is published: {reason:?}")],
        },
        Packet::SubAck(answer) => {
            let codes = answer.return_codes.iter();
            let failures = codes.filter(|code| !matches!(code, SubscribeReasonCode::Success(_)));
            failures.map(|code| format!("a subscription: {code:?}")).collect()
        }
        _ => Vec::new(),
    }
}

/// Returns whether data from the broker are no message of MQTT version 5. The library gives the same kind of error for
/// connections that break and for messages above the broker's limit, which are excluded here.
fn is_malformed(error: &ConnectionError) -> bool {
    let ConnectionError::MqttState(StateError::Deserialization(error)) = error else { return false };
    match error {
        // An end within a message has this kind, which errors of the system do not have.
        PacketError::Io(error) => error.kind() == ErrorKind::Other,
        PacketError::OutgoingPacketTooLarge { .. } => false,
        _ => true,
    }
}

/// Returns whether the broker has closed the connection properly.
fn is_closing(error: &ConnectionError) -> bool {
    matches!(error, ConnectionError::MqttState(StateError::ServerDisconnect { .. } | StateError::ConnectionAborted))
}

/// Describes the cause of a failed connection, with a remedy. `was_up` is whether the broker had accepted it. Data from the
/// broker are never shown, since a server that echoes its input would echo the password.
fn describe_error(error: &ConnectionError, was_up: bool, is_encrypted: bool) -> String {
    use rumqttc::v5::mqttbytes::v5::ConnectReturnCode as Code;
    let [encryption, certificate] = match (was_up, is_encrypted) {
        (true, _) => ["", ""],
        (false, false) => ["; it may expect encryption: mqtts://", ""],
        (false, true) => {
            ["", "; it may ask for a client certificate, which radome cannot give, or it may not encrypt: mqtt://"]
        }
    };
    match error {
        ConnectionError::NotConnAck(_) => format!("it does not answer in MQTT version 5{encryption}"),
        _ if is_malformed(error) => format!("it does not answer in MQTT version 5{encryption}"),
        // The library takes the refusal of an older version for the beginning of an answer.
        ConnectionError::MqttState(StateError::ConnectionAborted) if !was_up => {
            format!("it closes the connection and does not answer in MQTT version 5{encryption}{certificate}")
        }
        ConnectionError::Io(error)
        | ConnectionError::Tls(TlsError::Io(error))
        | ConnectionError::MqttState(StateError::Io(error) | StateError::Deserialization(PacketError::Io(error))) => {
            let cause = error.get_ref().and_then(|cause| cause.downcast_ref::<rustls::Error>());
            match (cause, error.kind()) {
                (Some(rustls::Error::AlertReceived(rustls::AlertDescription::CertificateRequired)), _) => {
                    "it asks for a client certificate, which radome cannot give".into()
                }
                (Some(cause), _) => format!("TLS: {cause}"),
                (None, ErrorKind::ConnectionReset | ErrorKind::BrokenPipe | ErrorKind::UnexpectedEof) => {
                    format!("{error}{encryption}{certificate}")
                }
                (None, _) => error.to_string(),
            }
        }
        ConnectionError::MqttState(
            StateError::OutgoingPacketTooLarge { pkt_size, max }
            | StateError::Deserialization(PacketError::OutgoingPacketTooLarge { pkt_size, max }),
        ) => {
            format!(
                "its limit of {max} bytes is below the {pkt_size} of the announcement: raise it at the broker \
                 (max_packet_size of mosquitto)"
            )
        }
        ConnectionError::Timeout(_) => "no answer".into(),
        ConnectionError::ConnectionRefused(Code::BadUserNamePassword | Code::NotAuthorized) => {
            "it refuses the login (user in the URL or in RADOME_MQTT_USER; password in --mqtt-password-file or in \
             RADOME_MQTT_PASSWORD)"
                .into()
        }
        ConnectionError::ConnectionRefused(code) => format!("it refuses the connection: {code:?}"),
        ConnectionError::Tls(error) => format!("TLS: {error}"),
        ConnectionError::MqttState(StateError::ServerDisconnect { reason_code, .. }) => {
            format!("it ends the connection: {reason_code:?}")
        }
        ConnectionError::MqttState(error) => error.to_string(),
        ConnectionError::RequestsDone => "there is nothing more to send".into(),
    }
}

/// Publishes answers and availability.
struct Publisher<'a> {
    mqtt: &'a Mqtt,
    client: AsyncClient,
    /// Availability last published on this connection.
    published_online: Option<bool>,
    /// Time of the last announcement to the hub.
    last_announcement: Option<Instant>,
    needs_announcement: bool,
    /// Whether a failed publication was reported.
    has_warned: AtomicBool,
}

impl Publisher<'_> {
    async fn publish_until_stopped(
        &mut self,
        events: &mut mpsc::Receiver<BrokerEvent>,
        stop: &mut watch::Receiver<bool>,
    ) {
        let mut changes = self.mqtt.latest.changes();
        let mut check = tokio::time::interval(CHECK_INTERVAL);
        let mut last_publication = Instant::now();
        let mut is_connected = false;
        loop {
            tokio::select! {
                biased;
                _ = stop.changed() => break,
                event = events.recv() => match event {
                    Some(BrokerEvent::Connected) => {
                        is_connected = true;
                        self.published_online = None;
                        self.last_announcement = None;
                        self.needs_announcement = true;
                        self.subscribe();
                    }
                    Some(BrokerEvent::Lost) => is_connected = false,
                    Some(BrokerEvent::HubOnline) => self.needs_announcement = true,
                    Some(BrokerEvent::HubOffline) => {}
                    Some(BrokerEvent::Report(truth)) => match &self.mqtt.reports {
                        Some(reports) => {
                            reports.send(Report { truth, channel: "mqtt" });
                        }
                        None => count(&self.mqtt.latest.counters.reports_refused),
                    },
                    None => std::future::pending().await,
                },
                _ = changes.changed() => {
                    if is_connected {
                        self.publish_status(true);
                        last_publication = Instant::now();
                    }
                }
                _ = check.tick() => {}
            }
            if !is_connected {
                continue;
            }
            if self.needs_announcement && self.last_announcement.is_none_or(|time| time.elapsed() >= CHECK_INTERVAL) {
                self.announce();
                last_publication = Instant::now();
            }
            let is_online = self.mqtt.latest.answer().is_some();
            let is_due = last_publication.elapsed() >= HEARTBEAT;
            if is_due || self.published_online != Some(is_online) {
                self.publish_status(is_due || is_online);
                last_publication = Instant::now();
            }
        }
        if is_connected {
            self.publish(&self.mqtt.device.availability_topic(), "offline".into());
            let _ = self.client.try_disconnect();
        }
    }

    fn subscribe(&self) {
        for topic in self.mqtt.device.subscribed_topics() {
            // The queue is nearly empty, since nothing else is sent before.
            let _ = self.client.try_subscribe(topic, QoS::AtLeastOnce);
        }
    }

    /// Publishes the device, its availability and its state.
    fn announce(&mut self) {
        let device = &self.mqtt.device;
        self.publish(&device.discovery_topic(), device.discovery().to_string());
        self.needs_announcement = false;
        self.last_announcement = Some(Instant::now());
        self.publish_status(true);
    }

    /// Publishes the availability and, if `with_state` is set, the newest state.
    fn publish_status(&mut self, with_state: bool) {
        let latest = &self.mqtt.latest;
        let answer = latest.answer();
        if let Some(answer) = answer.filter(|_| with_state) {
            let (_, dropped) = latest.frames();
            self.publish(&self.mqtt.device.state_topic(), state(&answer, dropped).to_string());
        }
        let availability = if answer.is_some() { "online" } else { "offline" };
        // Published even if unchanged: the last will of a connection that died unnoticed may have published another state.
        self.publish(&self.mqtt.device.availability_topic(), availability.into());
        self.published_online = Some(answer.is_some());
    }

    /// Publishes a retained message, so that later subscribers receive it too. If the queue is full, the broker takes
    /// no messages; the next heartbeat repeats it.
    fn publish(&self, topic: &str, message: String) {
        if self.client.try_publish(topic, QoS::AtLeastOnce, true, message).is_ok() {
            count(&self.mqtt.latest.counters.mqtt_published);
        } else if !self.has_warned.swap(true, Ordering::Relaxed) {
            tracing::warn!("MQTT broker {}: a message to {topic} could not be sent", self.mqtt.broker);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::{Shutdown, TcpListener};

    use rumqttc::v5::mqttbytes::v5::{Connect, Login, PubAck, SubAck};

    use super::*;

    /// A server that echoes its input returns the login, which is in the first packet of the connection.
    #[test]
    fn a_login_that_comes_back_is_not_shown() {
        let connect = Connect { keep_alive: 15, client_id: "radome-1".into(), clean_start: true, properties: None };
        let login = Login { username: "radar".into(), password: "hunter2".into() };
        let error = ConnectionError::NotConnAck(Box::new(Packet::Connect(connect, None, Some(login))));
        assert!(error.to_string().contains("hunter2"), "the library shows it");
        assert!(!describe_error(&error, false, false).contains("hunter2"));
    }

    /// Regression test: for a broker that refuses version 5 with an answer of version 3.1.1, the message said that the
    /// connection was closed abruptly.
    #[test]
    fn a_broker_of_an_older_version_is_reported_as_such() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = listener.local_addr().expect("an address").port();
        let broker = std::thread::spawn(move || {
            let (mut connection, _) = listener.accept().expect("a client");
            // The rest of the request may be lost with the connection.
            connection.read_exact(&mut [0; 10]).expect("a request");
            connection.write_all(&[0x20, 0x02, 0x00, 0x01]).expect("answers");
            connection.shutdown(Shutdown::Write).expect("closes");
            // The client closes its side, so that its request is not answered by a reset.
            let _ = std::io::copy(&mut connection, &mut std::io::sink());
        });
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let (client, mut event_loop) = AsyncClient::new(MqttOptions::new("radome-1", "127.0.0.1", port), 8);
        let error = runtime.block_on(event_loop.poll()).expect_err("a refusal");
        let description = describe_error(&error, false, false);
        assert!(description.contains("does not answer in MQTT version 5"), "{description}");
        // The end of a connection that was up does not depend on versions.
        assert!(!describe_error(&error, true, false).contains("version"));
        drop((client, event_loop));
        broker.join().expect("no panic");
    }

    /// Regression test: each of these was said to be a broker that does not answer in MQTT version 5, and was counted as a
    /// message that is refused.
    #[test]
    fn a_lost_connection_and_a_limit_are_not_reported_as_another_version() {
        let of = |error| ConnectionError::MqttState(StateError::Deserialization(error));
        let alert = rustls::Error::AlertReceived(rustls::AlertDescription::CertificateRequired);
        for (error, is_encrypted, expected) in [
            (PacketError::Io(ErrorKind::ConnectionReset.into()), false, "connection reset"),
            (
                PacketError::Io(std::io::Error::new(ErrorKind::InvalidData, alert)),
                true,
                "asks for a client certificate",
            ),
            (PacketError::OutgoingPacketTooLarge { pkt_size: 1523, max: 1000 }, false, "1000 bytes is below the 1523"),
        ] {
            let error = of(error);
            let description = describe_error(&error, true, is_encrypted);
            assert!(description.contains(expected) && !description.contains("version"), "{description}");
            assert!(!is_malformed(&error) && !is_closing(&error), "{description}");
        }
        let malformed = of(PacketError::InvalidPacketType(15));
        assert!(is_malformed(&malformed) && describe_error(&malformed, true, false).ends_with("in MQTT version 5"));
    }

    #[test]
    fn a_port_that_was_never_up_may_expect_encryption_or_a_certificate() {
        let of = |error| ConnectionError::MqttState(StateError::Deserialization(error));
        let malformed = of(PacketError::InvalidPacketType(15));
        assert!(describe_error(&malformed, false, false).contains("mqtts://"));
        assert!(!describe_error(&malformed, false, true).contains("mqtts://"));
        let reset = of(PacketError::Io(ErrorKind::ConnectionReset.into()));
        assert!(describe_error(&reset, false, false).contains("mqtts://"));
        assert!(describe_error(&reset, false, true).contains("client certificate"));
    }

    /// Regression test: for a broker that takes no encrypted connections, the message only named a missing client certificate.
    #[test]
    fn an_encrypted_connection_that_breaks_may_be_to_a_port_that_does_not_encrypt() {
        let broken = |kind: ErrorKind| ConnectionError::Tls(TlsError::Io(kind.into()));
        for kind in [ErrorKind::UnexpectedEof, ErrorKind::ConnectionReset] {
            let description = describe_error(&broken(kind), false, true);
            assert!(description.contains("it may not encrypt: mqtt://"), "{description}");
            assert!(!describe_error(&broken(kind), true, true).contains("encrypt"), "it was up");
        }
    }

    #[test]
    fn answers_of_a_broker_that_rejects_name_their_reason() {
        let answer = |reason| Packet::PubAck(PubAck { reason, ..PubAck::new(1, None) });
        assert!(rejections(&answer(PubAckReason::NoMatchingSubscribers)).is_empty());
        assert_eq!(rejections(&answer(PubAckReason::NotAuthorized)), ["what is published: NotAuthorized"]);
        let return_codes = vec![SubscribeReasonCode::Success(QoS::AtLeastOnce), SubscribeReasonCode::NotAuthorized];
        let answer = Packet::SubAck(SubAck { pkid: 2, return_codes, properties: None });
        assert_eq!(rejections(&answer), ["a subscription: NotAuthorized"]);
    }
}
