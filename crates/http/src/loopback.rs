//! The routes without a socket, for the fuzzer.

use drivegate_north::NorthState;
use std::sync::Arc;
use std::{fmt, io};

use axum::Router;
use axum::body::Body;
use hyper::service::Service;
use hyper::{Request, Uri, header};
use hyper_util::service::TowerToHyperService;
use tokio::runtime::{Builder, Runtime};
use tokio_util::sync::CancellationToken;

use super::operating::Operating;
use super::reached::{Client, Coverage, Reached};
use super::routes;
use drivegate_core::plant::SharedPlant;

/// An HTTP server without its socket.
pub struct Loopback {
    service: TowerToHyperService<Router>,
    runtime: Runtime,
    client: Client,
    reached: Reached,
}

impl fmt::Debug for Loopback {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Loopback")
    }
}

impl Loopback {
    /// A server for this plant.
    ///
    /// # Errors
    /// If the system does not provide what a timer needs.
    pub fn new(plant: SharedPlant) -> io::Result<Loopback> {
        let router = routes::router(
            plant,
            Default::default(),
            Arc::new(Operating::new(&NorthState::default())),
            CancellationToken::new(),
        );
        let service = TowerToHyperService::new(router);
        let reached = Reached::within(None, None);
        let client = Client {
            address: reached.address,
            coverage: Coverage::Everything,
        };
        let runtime = Builder::new_current_thread().enable_time().build()?;
        Ok(Loopback {
            service,
            runtime,
            client,
            reached,
        })
    }

    /// The status of the reply to GET `target`, a path with query; `None` if the target is invalid.
    pub fn get(&self, target: &[u8]) -> Option<u16> {
        let uri = Uri::try_from(target).ok().filter(|uri| uri.path().starts_with('/'))?;
        let request = Request::get(uri).header(header::HOST, "127.0.0.1");
        let request = request.extension(self.client).extension(self.reached.clone());
        let request = request.body(Body::empty()).ok()?;
        let response = self.runtime.block_on(self.service.call(request)).ok()?;
        Some(response.status().as_u16())
    }
}
