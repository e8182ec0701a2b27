//! A reading of parameters: begun, then asked for until it is over, through the gateway or on a bus of its own.

use std::time::Duration;

use super::direct::Direct;
use super::{Target, gateway, log_audit_only};
use crate::north::local::protocol::{Outcome, ParamsOutcome, ParamsRequest, Request};

/// Time between two looks at how far it is.
const LOOK: Duration = Duration::from_millis(250);

/// Cadence of process data on a bus of its own.
const RESTFUL: Duration = Duration::from_secs(1);

impl Target {
    /// Reads all parameters of the drive, afresh, briskly, or neither; the text of the file. `progress` is told how far it is.
    ///
    /// # Errors
    /// Why there is none, as a message.
    pub(in crate::cli) fn read_parameters(
        &self,
        how: (bool, bool),
        progress: impl FnMut(&ParamsOutcome),
    ) -> Result<String, String> {
        crate::cli::runtime()?.block_on(self.read_all(how, progress))
    }

    async fn read_all(
        &self,
        (afresh, brisk): (bool, bool),
        mut progress: impl FnMut(&ParamsOutcome),
    ) -> Result<String, String> {
        let request = |begin| {
            Request::Params(ParamsRequest {
                drive: self.spec.name.clone(),
                expect: Some(self.expected()),
                begin,
                afresh,
                brisk,
            })
        };
        let (mut outcome, direct) = match gateway::ask(self, &request(true)).await? {
            Ok(outcome) => (outcome, None),
            Err(not_found) => {
                log_audit_only();
                // Nobody looks at its process data: the line is there for the parameters.
                let mut alone = self.clone();
                alone.bus.spec.cycle = RESTFUL.max(alone.bus.spec.cycle);
                let direct = Direct::start(&alone, &not_found).await?;
                (direct.ask(&request(true)).await, Some(direct))
            }
        };
        let text = loop {
            match outcome {
                Outcome::Params(ParamsOutcome { file: Some(file), .. }) => break Ok(file),
                Outcome::Params(ParamsOutcome { error: Some(why), .. }) => {
                    break Err(format!(
                        "the parameters of `{}` were not read: {why}; its bus; try again",
                        self.spec.name
                    ));
                }
                Outcome::Params(status) => progress(&status),
                other => break Err(other.not_asked_for()),
            }
            tokio::time::sleep(LOOK).await;
            outcome = match &direct {
                Some(direct) => direct.ask(&request(false)).await,
                None => match gateway::ask(self, &request(false)).await {
                    Ok(Ok(outcome)) => outcome,
                    Ok(Err(gone)) => {
                        break Err(format!("the gateway is gone: {}; the local socket; try again", gone.0));
                    }
                    Err(why) => break Err(why),
                },
            };
        };
        if let Some(direct) = direct {
            direct.stop().await;
        }
        text
    }
}
