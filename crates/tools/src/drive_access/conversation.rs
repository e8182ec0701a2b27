//! Several requests about one drive, all through one connection.

use super::direct::{Direct, Needs};
use super::{RequestRoute, Target};
use crate::client::{Client, ClientError, GatewayRequest, Reply};
use drivegate_gateway::config::{LogFormat, LogSettings};

/// Requests about one drive, to the gateway or to the bus of this process.
pub(super) struct Conversation {
    client: Client,
    direct: Option<Direct>,
}

impl Conversation {
    /// Sends the first request to the gateway or, if there is none, opens the port; returns the reply.
    ///
    /// # Errors
    /// If no connection is possible; contains the reason as a message.
    pub(super) async fn begin(
        target: &Target,
        asked: &GatewayRequest,
        needs: Needs<'_>,
    ) -> Result<(Conversation, Reply), String> {
        let client = target.client.clone();
        let missed = match client.ask(asked).await {
            Ok(reply) => return Ok((Conversation { client, direct: None }, reply)),
            Err(ClientError::NotFound(missed)) => missed,
            Err(error) => return Err(error.to_string()),
        };
        let Some(configured) = &target.configured else {
            return Err(ClientError::NotFound(missed).to_string());
        };
        let not_found = configured.not_found(&missed, client.doors())?;
        log_audit_only();
        let direct = Direct::start(configured, needs, &not_found).await?;
        let conversation = Conversation {
            client: direct.client(),
            direct: Some(direct),
        };
        match conversation.ask(asked).await {
            Ok(reply) => Ok((conversation, reply)),
            Err(why) => {
                conversation.end().await;
                Err(why)
            }
        }
    }

    /// Sends a further request.
    ///
    /// # Errors
    /// If there is no reply; contains the reason as a message.
    pub(super) async fn ask(&self, asked: &GatewayRequest) -> Result<Reply, String> {
        self.client.ask(asked).await.map_err(|error| match error {
            ClientError::NotFound(_) => "the gateway is gone; the local socket; start it and try again".to_string(),
            error => error.to_string(),
        })
    }

    pub(super) fn way(&self) -> RequestRoute {
        match self.direct {
            None => RequestRoute::Gateway,
            Some(_) => RequestRoute::Direct,
        }
    }

    /// Closes the port if it is open.
    pub(super) async fn end(self) {
        if let Some(direct) = self.direct {
            direct.stop().await;
        }
    }
}

/// The command itself reports what happens; only the audit lines of the log are kept.
fn log_audit_only() {
    crate::log::start_in_order(&LogSettings {
        level: "off,audit=info".to_string(),
        format: LogFormat::Auto,
    });
}
