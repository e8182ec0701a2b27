//! Readings and restores of parameters: started, then polled until they have ended, through the gateway or on a bus
//! of the command.

use std::time::Duration;

use super::{Conversation, Needs, Target};
use crate::client::GatewayRequest;
use drivegate_http::messages::{ParameterReading, PreparedRestore, ReadParameters, Restore, RestoreAct, Stage};

/// Time between two looks at the progress.
const LOOK: Duration = Duration::from_millis(250);

impl Target {
    /// Reads all parameters of the drive; the text of the file. `progress` gets how far it is.
    ///
    /// # Errors
    /// If the parameters cannot be read; contains the reason as a message.
    pub(crate) fn read_parameters(
        &self,
        how: ReadParameters,
        progress: impl FnMut(&ParameterReading),
    ) -> Result<String, String> {
        crate::without_waiting_for_threads(self.read_all(how, progress))
    }

    async fn read_all(
        &self,
        how: ReadParameters,
        mut progress: impl FnMut(&ParameterReading),
    ) -> Result<String, String> {
        let remedy = "parameters can be read from drives whose profile lists them, on lines that the gateway owns";
        let path = self.path("params/reading");
        let (begin, look) = (GatewayRequest::post(&path, &how), GatewayRequest::get(&path));
        let [begin, look] = [begin, look].map(|asked| asked.if_refused(remedy).if_lost("try again"));
        let (conversation, mut reply) = Conversation::begin(self, &begin, Needs::Identification).await?;
        let text = loop {
            match reply.accepted(&look) {
                Ok(ParameterReading { file: Some(file), .. }) => break Ok(file),
                Ok(ParameterReading { error: Some(why), .. }) => {
                    break Err(format!(
                        "the parameters of `{}` were not read: {why}; its bus; try again",
                        self.drive
                    ));
                }
                Ok(status) => progress(&status),
                Err(error) => break Err(error.to_string()),
            }
            tokio::time::sleep(LOOK).await;
            reply = match conversation.ask(&look).await {
                Ok(reply) => reply,
                Err(why) => break Err(why),
            };
        };
        conversation.end().await;
        text
    }

    /// Starts an action on a restore of the drive, or without one only follows the restore, and waits until it has
    /// ended; a prepared restore is carried out if `agreed` returns true. `progress` gets each state. Returns the
    /// last known state.
    ///
    /// # Errors
    /// If the restore could not be started, or is no longer known; contains the reason as a message.
    pub(crate) fn restore_parameters(
        &self,
        act: Option<RestoreAct>,
        agreed: impl FnMut(&Restore) -> bool,
        progress: impl FnMut(&Restore),
    ) -> Result<Restore, String> {
        crate::without_waiting_for_threads(self.restore_all(act, agreed, progress))
    }

    async fn restore_all(
        &self,
        act: Option<RestoreAct>,
        mut agreed: impl FnMut(&Restore) -> bool,
        mut progress: impl FnMut(&Restore),
    ) -> Result<Restore, String> {
        let path = self.path("params/restore");
        let request = |act: Option<RestoreAct>| {
            let asked = match act {
                Some(act) => GatewayRequest::post(&path, &act),
                None => GatewayRequest::get(&path),
            };
            asked.if_lost(format!(
                "a started restore continues in the gateway: see `{}`",
                self.restore_command()
            ))
        };
        let mut asked = request(act);
        let (conversation, mut reply) = Conversation::begin(self, &asked, Needs::Identification).await?;
        let ended = loop {
            let next = match reply.accepted::<Restore>(&asked) {
                Ok(status) => match status.stage {
                    Stage::Prepared if agreed(&status) => {
                        Some(RestoreAct::CarryOut(PreparedRestore { number: status.number }))
                    }
                    Stage::Reading | Stage::Working => {
                        progress(&status);
                        tokio::time::sleep(LOOK).await;
                        None
                    }
                    _ => break Ok(status),
                },
                Err(error) => break Err(error.to_string()),
            };
            asked = request(next);
            reply = match conversation.ask(&asked).await {
                Ok(reply) => reply,
                Err(why) => {
                    break Err(format!("{why}; `{}` shows the restore", self.restore_command()));
                }
            };
        };
        conversation.end().await;
        ended
    }
}
