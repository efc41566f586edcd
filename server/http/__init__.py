"""Requests and answers: authentication, origins, body limits, validation, problem documents."""
