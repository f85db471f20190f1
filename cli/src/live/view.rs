//! Live page: shows data and answers of the sensor in a browser. Labels can be edited; recordings can be played, paused
//! and sought.
//!
//! The classifier's thread passes the newest frame on ([`feed`]) and continues. A thread of the pages keeps the answers of
//! the last minutes ([`history`]) and makes pictures ([`picture`]), at most thirty per second and only those that a page
//! shows. [`server`] serves the pages, [`policy`] decides on access, and [`control`] handles requests of a page. [`label_set`]
//! holds the labels with their undo history, and [`label_store`] saves them. [`adaptation`] offers a command that uses the
//! labels, and [`partner`] is the simulation that mirrors a recording.

mod adaptation;
mod control;
mod cut_labels;
mod feed;
mod history;
mod label_set;
mod label_store;
mod partner;
mod picture;
mod policy;
mod server;
mod shared;

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use anyhow::Context;
use qrcode::render::unicode::Dense1x2;
use qrcode::{EcLevel, QrCode};
use radome_dsp::Gap;
use serde_json::json;
use tokio::runtime::Runtime;

use super::access::{self, Token};
use super::answer::Summary;
use super::health::Health;
use super::sink::{ClassifiedFrame, Sink};
use crate::panics::lock;
use crate::source::Source;
use feed::Feed;
use label_store::LabelStore;
use partner::Partner;
use policy::Policy;
use shared::{About, Shared};

/// Options of the page.
#[derive(clap::Args)]
pub struct Arguments {
    /// Serve a live page on this machine. Recordings are played in real time, and the page stays open at their end
    #[arg(long)]
    view: bool,
    /// Address of the page; only this machine can reach the default. A page that the network can reach requires the token in its link
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8060", requires = "view", value_parser = access::address)]
    listen: SocketAddr,
    /// Let pages show and download labels, but not change them
    #[arg(long, requires = "view")]
    read_only_labels: bool,
    #[command(flatten)]
    pub access: access::Arguments,
    /// Folder that `radome scene pair` made for the recording: the page also shows the simulated recording in it. NAME-pair beside
    /// NAME.mcap if absent
    #[arg(long, value_name = "DIR", requires = "view")]
    pair: Option<PathBuf>,
}

impl Arguments {
    pub fn is_wanted(&self) -> bool {
        self.view
    }
}

/// Interface of the page to the pipeline.
pub struct Page {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl Page {
    /// Starts the server if the page is requested. If the source is not a recording, labels go to `recording`, which is being
    /// written. Its flag is set when the recorder has failed. `name` is the radar's own, if it has one. People farther away
    /// than `max_range_m`, if given, do not count.
    ///
    /// # Errors
    /// The port cannot be opened, the token or the labels cannot be read, or a thread cannot be started.
    pub fn open(
        arguments: &Arguments,
        source: &Source,
        model: &Path,
        max_range_m: Option<f64>,
        recording: Option<(&Path, Arc<AtomicBool>)>,
        name: Option<&str>,
    ) -> anyhow::Result<Option<Page>> {
        if !arguments.view {
            return Ok(None);
        }
        let waveform = source.frames.waveform().clone();
        let playback = source.playback.clone();
        let partner = Partner::find(arguments.pair.as_deref(), playback.as_ref(), &waveform)?;
        let token = match arguments.access.token()? {
            None if !arguments.listen.ip().is_loopback() => Some(Token::random()?),
            token => token,
        };
        let runtime = runtime().context("cannot start the page's thread")?;
        let listener = runtime.block_on(tokio::net::TcpListener::bind(arguments.listen)).with_context(|| {
            format!(
                "cannot serve the page on {}\n\nhint: choose another with --listen 127.0.0.1:PORT",
                arguments.listen
            )
        })?;
        let address = listener.local_addr()?;
        show_link(address, token.as_ref(), arguments.read_only_labels);
        if token.is_none() && arguments.access.is_open_to_others() {
            tracing::warn!(
                "whoever reaches a host of --allow-host can use the page: --token-file FILE requires a token, unless the proxy asks for \
                 a password"
            );
        }
        let shared = Arc::new(Shared {
            labels: LabelStore::open(playback.as_ref(), recording, model, max_range_m, waveform.frame_interval_s())?,
            feed: Feed::new(&waveform, playback.is_some()),
            about: About {
                description: source.description.clone(),
                name: name.map(str::to_owned),
                model: model.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                board: source.board.clone(),
                has_partner: partner.is_some(),
                read_only_labels: arguments.read_only_labels,
                waveform,
                playback,
            },
            policy: Policy::new(address, &arguments.access, token.as_ref()),
            summary: Mutex::new(None),
        });
        let [for_maps, for_labels, for_server] = [(); 3].map(|()| shared.clone());
        let threads = vec![
            thread("page-maps", move || {
                lower_priority();
                for_maps.feed.serve(partner);
            })?,
            thread("page-labels", move || for_labels.labels.save_until_closed())?,
        ];
        // Detached thread, which ends with the program: a slow browser does not delay the end.
        thread("page-server", move || {
            lower_priority();
            runtime.block_on(server::serve(listener, for_server));
        })?;
        Ok(Some(Page { shared, threads }))
    }
}

/// Creates a runtime with one thread for all connections.
fn runtime() -> std::io::Result<Runtime> {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(1).thread_name("page").on_thread_start(lower_priority).enable_all().build()
}

fn thread(name: &str, work: impl FnOnce() + Send + 'static) -> std::io::Result<JoinHandle<()>> {
    std::thread::Builder::new().name(name.into()).spawn(work)
}

/// Prints the address of the page on stderr, and how to open it.
fn show_link(address: SocketAddr, token: Option<&Token>, is_read_only: bool) {
    let Some(token) = token else {
        message!("live page: http://{address}");
        return;
    };
    let is_terminal = std::io::stderr().is_terminal();
    // If stderr is not a terminal, it may be a journal that others read. A token in a file is available without it; one
    // of this run is not.
    if let Some(file) = token.file().filter(|_| !is_terminal) {
        message!("live page: http://{}/?token=TOKEN with the token in {}", access::reachable(address), file.display());
    } else {
        let link = format!("http://{}/?token={}", access::reachable(address), token.text());
        message!("live page: {link}");
        if is_terminal && !address.ip().is_loopback() {
            print_code(&link);
        }
    }
    if !address.ip().is_loopback() {
        let permitted = if is_read_only { "watch" } else { "watch and label" };
        message!(
            "whoever has the token can {permitted}; the connection is not encrypted, so use a network that you trust"
        );
    }
}

/// Prints a link as a QR code, white on black regardless of the terminal's colours.
fn print_code(link: &str) {
    match QrCode::with_error_correction_level(link, EcLevel::L) {
        Ok(code) => {
            let picture = code.render::<Dense1x2>().dark_color(Dense1x2::Light).light_color(Dense1x2::Dark).build();
            for line in picture.lines() {
                message!("\x1b[40;97m{line}\x1b[0m");
            }
        }
        Err(error) => tracing::debug!("no QR code of the link: {error}"),
    }
}

/// Lowers the priority of this thread below the pipeline's threads, so that pages and their requests cause no frame
/// loss.
fn lower_priority() {
    // Linux stores the priority per thread. Where it does not apply or is not permitted, all threads are equal.
    if let Err(error) = rustix::process::nice(10) {
        tracing::debug!("the page's threads keep their priority: {error}");
    }
}

impl Sink for Page {
    fn answer(&mut self, classified: &ClassifiedFrame) -> anyhow::Result<()> {
        self.shared.labels.set_newest_s(classified.answer.time_s);
        self.shared.feed.publish(classified);
        Ok(())
    }

    fn gap(&mut self, _gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        self.shared.feed.gap();
        Ok(())
    }

    fn end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        if let Some(playback) = &self.shared.about.playback {
            playback.transport.close();
        }
        *lock(&self.shared.summary) = Some(json!({ "over": summary }));
        self.shared.feed.close();
        self.shared.labels.close();
        for thread in self.threads.drain(..) {
            if thread.join().is_err() {
                tracing::error!("a thread of the live page has failed");
            }
        }
        server::wait_for_disconnections(&self.shared);
        self.shared.labels.finish()
    }
}
