//! Orders of local clients to the gateway itself rather than to a drive.

use std::path::{Path, PathBuf};
use std::time::Instant;

use tokio::sync::{mpsc, oneshot};

use super::protocol::{Failure, FailureCode, HealthOutcome, OfGateway, ReloadOutcome, StopAllRequest};
use crate::command::Origin;
use crate::plant::Plant;
use crate::stop_all::{NothingToStop, Scope, StopReport, WAIT};
use crate::{NorthStats, readiness};

/// Orders that wait; there are no more clients than that.
const WAITING: usize = super::MAX_CLIENTS;

/// Somebody wants the gateway to read its configuration anew.
#[derive(Debug)]
pub struct ReloadOrder {
    /// Who.
    pub who: String,
    /// Where the outcome goes.
    pub answer: oneshot::Sender<ReloadOutcome>,
}

/// How the local socket reaches the gateway that it belongs to.
#[derive(Debug, Clone)]
pub struct Control {
    config: PathBuf,
    orders: mpsc::Sender<ReloadOrder>,
}

impl PartialEq for Control {
    fn eq(&self, other: &Control) -> bool {
        self.config == other.config && self.orders.same_channel(&other.orders)
    }
}

impl Control {
    /// For a gateway that runs with the configuration file `config`, and where its orders arrive.
    pub fn new(config: &Path) -> (Control, mpsc::Receiver<ReloadOrder>) {
        let (orders, arrive) = mpsc::channel(WAITING);
        let config = absolute(config);
        (Control { config, orders }, arrive)
    }
}

/// The path of a configuration file, the same from whatever directory and by whatever link it is named.
pub fn absolute(config: &Path) -> PathBuf {
    let found = config.canonicalize().or_else(|_| std::path::absolute(config));
    found.unwrap_or_else(|_| config.to_path_buf())
}

/// Whether the client means this gateway.
fn is_meant(control: Option<&Control>, asked: &OfGateway) -> Result<(), Failure> {
    let Some(wanted) = &asked.config else { return Ok(()) };
    match control {
        Some(control) if absolute(&control.config) == Path::new(wanted) => Ok(()),
        Some(control) => Err(Failure::new(
            FailureCode::OtherGateway,
            format!("the gateway runs with {}", control.config.display()),
        )),
        None => Err(Failure::new(
            FailureCode::OtherGateway,
            "the gateway runs without a configuration file",
        )),
    }
}

/// Lets the gateway read its configuration anew, and waits for the outcome.
///
/// # Errors
/// It is another gateway, or it stops.
pub(crate) async fn reload(
    control: Option<&Control>,
    asked: &OfGateway,
    who: String,
) -> Result<ReloadOutcome, Failure> {
    is_meant(control, asked)?;
    let stops = || {
        Failure::new(
            FailureCode::Stopping,
            "the gateway stops, and reads its configuration no more",
        )
    };
    let control = control.ok_or_else(|| {
        Failure::new(
            FailureCode::BadRequest,
            "the gateway has no configuration file that it could read",
        )
    })?;
    let (answer, outcome) = oneshot::channel();
    let order = ReloadOrder { who, answer };
    control.orders.send(order).await.map_err(|_| stops())?;
    outcome.await.map_err(|_| stops())
}

/// Stops all drives, and waits for what becomes of them.
///
/// # Errors
/// It is another gateway, or there is nothing to stop.
pub(super) async fn stop_all(
    control: Option<&Control>,
    asked: &StopAllRequest,
    plant: &Plant,
    origin: &Origin,
) -> Result<StopReport, Failure> {
    let gateway = OfGateway {
        config: asked.config.clone(),
    };
    is_meant(control, &gateway)?;
    let scope = match (&asked.bus, &asked.group) {
        (None, None) => Scope::Gateway,
        (Some(bus), None) => Scope::Bus(bus.clone()),
        (None, Some(group)) => Scope::Group(group.clone()),
        (Some(_), Some(_)) => {
            let message = "both a bus and a group are named, so no stop was sent";
            return Err(Failure::new(FailureCode::BadRequest, message));
        }
    };
    let order = plant.stop_all.order(plant, &scope, origin, WAIT, Instant::now());
    let order = order.map_err(|why: NothingToStop| Failure::new(FailureCode::BadRequest, why.to_string()))?;
    let stops = |_| Failure::new(FailureCode::Stopping, "the gateway stops");
    order.report.await.map_err(stops)
}

/// Whether the gateway is ready, as `/readyz` says.
///
/// # Errors
/// It is another gateway.
pub(super) fn health(
    control: Option<&Control>,
    asked: &OfGateway,
    plant: &Plant,
    stats: &NorthStats,
) -> Result<HealthOutcome, Failure> {
    is_meant(control, asked)?;
    let reasons = readiness::reasons(plant, stats);
    Ok(HealthOutcome {
        ready: reasons.is_empty(),
        reasons,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn only_the_gateway_of_that_file_is_meant_and_every_order_is_answered() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("drivegate.toml");
        std::fs::write(&file, "").unwrap();
        let link = folder.path().join("link.toml");
        std::os::unix::fs::symlink(&file, &link).unwrap();
        let (control, mut orders) = Control::new(&link);
        let of = |path: &Path| OfGateway {
            config: Some(absolute(path).display().to_string()),
        };
        let other = of(&folder.path().join("other.toml"));
        let refused = reload(Some(&control), &other, "uid 0".to_string()).await.unwrap_err();
        assert_eq!(refused.code, FailureCode::OtherGateway);
        assert_eq!(is_meant(None, &other).unwrap_err().code, FailureCode::OtherGateway);
        let refused = reload(None, &OfGateway::default(), "uid 0".to_string())
            .await
            .unwrap_err();
        assert_eq!(refused.code, FailureCode::BadRequest);
        let asked = of(&file);
        let (outcome, ()) = tokio::join!(reload(Some(&control), &asked, "uid 0".to_string()), async {
            let order = orders.recv().await.unwrap();
            assert_eq!(order.who, "uid 0");
            order.answer.send(ReloadOutcome::default()).unwrap();
        });
        assert_eq!(outcome.unwrap(), ReloadOutcome::default());
        let (outcome, ()) = tokio::join!(reload(Some(&control), &asked, "uid 0".to_string()), async {
            drop(orders.recv().await);
        });
        assert_eq!(outcome.unwrap_err().code, FailureCode::Stopping);
    }
}
