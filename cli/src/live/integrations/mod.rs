//! Connections of a run to other programs: MQTT for home automation, metrics for Prometheus, notifications for systemd.
//! Each reads the newest answer on a thread of its own and cannot block the classifier.

pub mod broker;
mod discovery;
mod http;
mod latest;
mod metrics;
pub mod mqtt;
mod report_buffer;
mod systemd;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::builder::NonEmptyStringValueParser;
use radome_driver::{BoardIdentity, RecordingHeader};
use radome_dsp::Occupancy;
use rumqttc::v5::MqttOptions;
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use self::broker::{Broker, BrokerArguments};
use self::discovery::Device;
use self::latest::{Latest, LatestSink};
use self::report_buffer::{BufferSink, Report, ReportSender, SavingThread};
use super::access::{self, Access};
use super::sink::Sink;
use crate::exit::wrong_use;

/// Options of the connections to other programs.
#[derive(clap::Args, Default)]
pub struct Arguments {
    #[command(flatten)]
    broker: BrokerArguments,
    /// With --mqtt: name of the radar in Home Assistant and in the title of the page; also its identity if the board has none
    #[arg(long, value_name = "NAME", requires = "mqtt", value_parser = NonEmptyStringValueParser::new())]
    mqtt_name: Option<String>,
    /// With --mqtt: topic prefix under which Home Assistant looks for devices
    #[arg(long, value_name = "TOPIC", default_value = "homeassistant", requires = "mqtt")]
    mqtt_discovery_prefix: String,
    /// Serve /metrics for Prometheus, and /health. If the network can reach this address, --token-file is required, and Prometheus
    /// sends the token as authorization: credentials_file
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = access::address)]
    metrics: Option<SocketAddr>,
    #[command(flatten)]
    keep: report_buffer::Arguments,
}

impl Arguments {
    pub fn has_metrics(&self) -> bool {
        self.metrics.is_some()
    }

    /// Returns the broker with the options of its connection; `None` where no broker is named. Files of the password and of
    /// certificates are read only here, since a pipe can be read only once.
    ///
    /// # Errors
    /// [`WrongUse`](crate::exit::WrongUse) for an option that is wrong; a file of the password or of certificates cannot be read.
    pub fn broker(&self) -> anyhow::Result<Option<(Broker, MqttOptions)>> {
        let Some(broker) = self.broker.broker()? else { return Ok(None) };
        check_prefix(&self.mqtt_discovery_prefix)?;
        let options = self.broker.options(&broker)?;
        Ok(Some((broker, options)))
    }

    /// Refuses metrics that the network reaches and no token protects.
    ///
    /// # Errors
    /// [`WrongUse`](crate::exit::WrongUse) for such an address.
    pub fn check_metrics(&self, access: &access::Arguments) -> anyhow::Result<()> {
        if let Some(address) = self.metrics.filter(|address| !address.ip().is_loopback() && !access.has_token()) {
            wrong_use!(
                "metrics on {address} are reached from the network, and say whether somebody is here\n\nhint: --token-file FILE protects \
                 them, and Prometheus is given the file as authorization: credentials_file"
            );
        }
        Ok(())
    }

    /// Returns the name of the radar, if the user gave one.
    pub fn name(&self) -> Option<&str> {
        self.mqtt_name.as_deref()
    }
}

/// Longest time to close connections.
const CLOSING_TIME: Duration = Duration::from_secs(4);
/// Number of frame intervals, and least time, without a frame after which a board counts as gone.
const SILENT_FRAMES: f64 = 20.0;
const SILENCE: Duration = Duration::from_secs(5);

/// Connections to other programs for as long as the run lasts.
pub struct Integrations {
    sinks: Vec<Box<dyn Sink>>,
    stop: watch::Sender<bool>,
    tasks: Vec<JoinHandle<()>>,
    runtime: Option<Runtime>,
    /// Declared after the runtime, whose tasks hold senders to it.
    saving_thread: Option<SavingThread>,
}

impl Integrations {
    /// Opens the requested connections. `broker` is the result of [`Arguments::broker`], `header` describes the source, and
    /// `access` has the options of the metrics' port. The broker identifies this radar by `board`, if one is at work.
    ///
    /// # Errors
    /// A port cannot be opened, the token cannot be read, a folder cannot be written, or a signal cannot be caught.
    pub fn open(
        arguments: &Arguments,
        broker: Option<(Broker, MqttOptions)>,
        access: &access::Arguments,
        header: &RecordingHeader,
        board: Option<&BoardIdentity>,
        started: Instant,
    ) -> anyhow::Result<Self> {
        let (stop, stopped) = watch::channel(false);
        let mut integrations =
            Integrations { sinks: Vec::new(), stop, tasks: Vec::new(), runtime: None, saving_thread: None };
        let is_notified = systemd::is_wanted();
        let buffers_frames = arguments.keep.is_wanted();
        if !buffers_frames {
            warn_of_ignored_signals()?;
        }
        if broker.is_none() && arguments.metrics.is_none() && !buffers_frames && !is_notified {
            return Ok(integrations);
        }
        let silence = Duration::from_secs_f64(SILENT_FRAMES * header.waveform.frame_interval_s()).max(SILENCE);
        let latest = Latest::new(started, silence);
        integrations.sinks.push(Box::new(LatestSink(latest.clone())));
        let mut reports = None;
        if let Some((buffer, sender, saving_thread)) = BufferSink::open(&arguments.keep, header, latest.clone())? {
            integrations.sinks.push(Box::new(buffer));
            integrations.saving_thread = Some(saving_thread);
            reports = Some(sender);
        }

        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("integrations")
            .enable_all()
            .build()?;
        let runtime_guard = runtime.enter();
        if let Some(address) = arguments.metrics {
            serve_metrics(&runtime, address, access, latest.clone(), reports.clone())?;
        }
        if let Some((broker, mut options)) = broker {
            let name = arguments.mqtt_name.as_deref();
            let device = Device::new(board, name, &arguments.mqtt_discovery_prefix, reports.is_some());
            options.set_client_id(device.client_id());
            let mqtt = mqtt::Mqtt { broker, options, device, latest: latest.clone(), reports: reports.clone() };
            integrations.tasks.push(tokio::spawn(mqtt.run(stopped.clone())));
        }
        if is_notified {
            integrations.tasks.push(tokio::spawn(systemd::run(latest.clone(), stopped.clone())));
        }
        if let Some(reports) = reports {
            let mut signals = signal(SignalKind::user_defined1()).context("cannot catch SIGUSR1")?;
            tokio::spawn(async move {
                while signals.recv().await.is_some() {
                    if !reports.send(Report { truth: Occupancy::Empty, channel: "signal" }) {
                        tracing::warn!("another report is being saved; this one is lost");
                    }
                }
            });
        }
        drop(runtime_guard);
        integrations.runtime = Some(runtime);
        Ok(integrations)
    }

    /// Takes the sinks for the classifier's thread.
    pub fn take_sinks(&mut self) -> Vec<Box<dyn Sink>> {
        std::mem::take(&mut self.sinks)
    }
}

/// Logs a warning at each SIGUSR1, which reports a wrong answer, that no report is kept. Without a handler, the signal would end
/// this program.
fn warn_of_ignored_signals() -> anyhow::Result<()> {
    let cannot = "cannot catch SIGUSR1";
    let mut signals = signal_hook::iterator::Signals::new([signal_hook::consts::SIGUSR1]).context(cannot)?;
    let wait = move || {
        for _ in signals.forever() {
            tracing::warn!("SIGUSR1 asks for a report, but --keep-to is not given: nothing is saved");
        }
    };
    std::thread::Builder::new().name("reports".into()).spawn(wait).context(cannot)?;
    Ok(())
}

/// Fails for a prefix that is not valid in a topic.
fn check_prefix(prefix: &str) -> anyhow::Result<()> {
    if prefix.trim_matches('/').is_empty() || prefix.contains(['#', '+', '\0']) {
        wrong_use!(
            "--mqtt-discovery-prefix {prefix:?}: expected a topic without # and +\n\nhint: Home Assistant's own is homeassistant"
        );
    }
    Ok(())
}

/// Opens the metrics' port. If the network reaches it, it has a token: see [`Arguments::check_metrics`].
fn serve_metrics(
    runtime: &Runtime,
    address: SocketAddr,
    access: &access::Arguments,
    latest: Arc<Latest>,
    reports: Option<ReportSender>,
) -> anyhow::Result<()> {
    let token = access.token()?;
    let listener = runtime.block_on(tokio::net::TcpListener::bind(address)).with_context(|| {
        format!("cannot serve metrics on {address}\n\nhint: choose another with --metrics 127.0.0.1:PORT")
    })?;
    let address = listener.local_addr()?;
    message!("metrics: http://{}/metrics", access::reachable(address));
    let access = Access::new(address, access, token.as_ref());
    runtime.spawn(http::serve(listener, access, latest, reports));
    Ok(())
}

impl Drop for Integrations {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        let Some(runtime) = self.runtime.take() else { return };
        let tasks = std::mem::take(&mut self.tasks);
        runtime.block_on(async {
            let end = async {
                for task in tasks {
                    let _ = task.await;
                }
            };
            let _ = tokio::time::timeout(CLOSING_TIME, end).await;
        });
        runtime.shutdown_timeout(Duration::from_secs(1));
        self.sinks.clear();
        // Waits until a report that is being saved is complete.
        self.saving_thread.take();
    }
}
