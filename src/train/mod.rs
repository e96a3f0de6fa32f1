//! Optimiser steps, their schedules, what is saved of them and what is told about them.

pub mod schedule;
