//! Readings and restores of parameters: begun, then asked for until they are over, through the gateway or on a bus of its own.

use std::time::Duration;

use super::direct::Direct;
use super::{Target, gateway, log_audit_only};
use crate::north::local::protocol::{
    Outcome, ParamsOutcome, ParamsRequest, Request, RestoreAct, RestoreOutcome, RestoreRequest, Stage,
};

/// Time between two looks at how far it is.
const LOOK: Duration = Duration::from_millis(250);

/// Cadence of process data on a bus of its own.
const RESTFUL: Duration = Duration::from_secs(1);

/// Several requests about one drive, all by the same way.
struct Conversation<'t> {
    target: &'t Target,
    direct: Option<Direct>,
}

impl Conversation<'_> {
    /// Asks the gateway or, where there is none, opens the port; the first answer.
    async fn begin<'t>(target: &'t Target, request: &Request) -> Result<(Conversation<'t>, Outcome), String> {
        let not_found = match gateway::ask(target, request).await? {
            Ok(outcome) => return Ok((Conversation { target, direct: None }, outcome)),
            Err(not_found) => not_found,
        };
        log_audit_only();
        // Nobody looks at its process data: the line is there for the parameters.
        let mut alone = target.clone();
        alone.bus.spec.cycle = RESTFUL.max(alone.bus.spec.cycle);
        let direct = Direct::start(&alone, &not_found).await?;
        let outcome = direct.ask(request).await;
        let direct = Some(direct);
        Ok((Conversation { target, direct }, outcome))
    }

    async fn ask(&self, request: &Request) -> Result<Outcome, String> {
        if let Some(direct) = &self.direct {
            return Ok(direct.ask(request).await);
        }
        let asked = gateway::ask(self.target, request).await?;
        asked.map_err(|gone| {
            format!(
                "the gateway is gone: {}; the local socket; start it and try again",
                gone.0
            )
        })
    }

    async fn end(self) {
        if let Some(direct) = self.direct {
            direct.stop().await;
        }
    }
}

impl Target {
    /// Reads all parameters of the drive, afresh, briskly, or neither; the text of the file. `progress` is told how far it is.
    ///
    /// # Errors
    /// Why there is none, as a message.
    pub(crate) fn read_parameters(
        &self,
        how: (bool, bool),
        progress: impl FnMut(&ParamsOutcome),
    ) -> Result<String, String> {
        crate::runtime()?.block_on(self.read_all(how, progress))
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
        let (conversation, mut outcome) = Conversation::begin(self, &request(true)).await?;
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
            outcome = match conversation.ask(&request(false)).await {
                Ok(outcome) => outcome,
                Err(why) => break Err(why),
            };
        };
        conversation.end().await;
        text
    }

    /// Does that with a restore of the drive, and waits until it is over; a restore that is prepared is carried out if `agreed`
    /// says so. `progress` is told how far it is. The last that was heard of it.
    ///
    /// # Errors
    /// Why it could not be begun, or is not heard of any more, as a message.
    pub(crate) fn restore_parameters(
        &self,
        act: RestoreAct,
        agreed: impl FnMut(&RestoreOutcome) -> bool,
        progress: impl FnMut(&RestoreOutcome),
    ) -> Result<RestoreOutcome, String> {
        crate::runtime()?.block_on(self.restore_all(act, agreed, progress))
    }

    async fn restore_all(
        &self,
        act: RestoreAct,
        mut agreed: impl FnMut(&RestoreOutcome) -> bool,
        mut progress: impl FnMut(&RestoreOutcome),
    ) -> Result<RestoreOutcome, String> {
        let request = |act| {
            Request::ParamsRestore(RestoreRequest {
                drive: self.spec.name.clone(),
                expect: Some(self.expected()),
                act,
            })
        };
        let (conversation, mut outcome) = Conversation::begin(self, &request(act)).await?;
        let ended = loop {
            let next = match outcome {
                Outcome::ParamsRestore(status) => match status.stage {
                    Stage::Prepared if agreed(&status) => RestoreAct::CarryOut { number: status.number },
                    Stage::Reading | Stage::Working => {
                        progress(&status);
                        tokio::time::sleep(LOOK).await;
                        RestoreAct::Look
                    }
                    _ => break Ok(status),
                },
                other => break Err(other.not_asked_for()),
            };
            outcome = match conversation.ask(&request(next)).await {
                Ok(outcome) => outcome,
                Err(why) => {
                    break Err(format!(
                        "{why}; `drivegate params restore --look {}` shows the restore",
                        self.spec.name
                    ));
                }
            };
        };
        conversation.end().await;
        ended
    }
}
