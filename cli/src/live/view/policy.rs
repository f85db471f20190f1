//! Access policy, limits and refusals of the page.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::Semaphore;

use crate::live::access::{self, Access, Token};

const MOST_PAGES: usize = 16;

/// Reason for refusing a connection, a request, a page or a message.
#[derive(Debug, Clone, Copy)]
pub enum Refusal {
    Connection,
    Unanswered,
    Host,
    Origin,
    NoToken,
    WrongToken,
    Method,
    Body,
    Path,
    Page,
    Message,
    Oversized,
    Flood,
}

/// Names of the refusals, in the order of the variants.
const REFUSALS: &str =
    "connections unanswered host origin no_token wrong_token method body path pages messages oversized flood";

impl From<access::Refusal> for Refusal {
    fn from(refusal: access::Refusal) -> Self {
        match refusal {
            access::Refusal::Host => Refusal::Host,
            access::Refusal::Origin => Refusal::Origin,
            access::Refusal::NoToken => Refusal::NoToken,
            access::Refusal::WrongToken => Refusal::WrongToken,
            access::Refusal::Body => Refusal::Body,
        }
    }
}

/// Access policy of the page, with the limit of pages and counters of refusals.
pub struct Policy {
    pub access: Access,
    pub pages: Arc<Semaphore>,
    refused: [AtomicU64; Refusal::Flood as usize + 1],
}

impl Policy {
    /// Creates the policy of a page that is served at `address`. With a token, clients must present it.
    pub fn new(address: SocketAddr, arguments: &access::Arguments, token: Option<&Token>) -> Self {
        Policy {
            access: Access::new(address, arguments, token),
            pages: Arc::new(Semaphore::new(MOST_PAGES)),
            refused: Default::default(),
        }
    }

    pub fn count(&self, refusal: Refusal) {
        if let Some(counter) = self.refused.get(refusal as usize) {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Number of refusals by name.
    pub fn refused(&self) -> serde_json::Value {
        let refused = REFUSALS.split(' ').zip(&self.refused);
        let refused = refused.map(|(name, count)| (name.to_owned(), count.load(Ordering::Relaxed).into()));
        refused.collect::<serde_json::Map<String, serde_json::Value>>().into()
    }
}
